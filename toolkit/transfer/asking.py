"""A tree that asks: a target is approached from whichever robot leaves the least of the way to it.

The shortest tree says which robots lie between others, not whose policy carries over: that of one jaw may hold on half the way to a
hand of three fingers on which every meta robot's fails. So whenever a path is to begin, every robot on which there is a policy (the
source, meta robots, targets reached) is asked how far that policy holds on the straight way to each target that is left, by looks of
a batch each. The tree is the guess that the answers have to beat. What has settled on one gripper may be hard to bring to another: a path
that costs much is raced against one from the source.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from toolkit.evolution import Metric
from toolkit.evolution.geometry import distances
from toolkit.learning.policy import GaussianPolicy, ValueFunction, learner_tensors, load_learner
from toolkit.transfer.branch import Branch


@dataclass(frozen=True)
class Leap:
    """The best answer for a target so far.

    Attributes:
        origin: index of the robot that gave it.
        share: of the straight way from there to the target at which its policy holds.
        left: distance from there on [alpha]; infinite while nobody's policy holds anywhere on its way.
    """

    origin: int = -1
    share: float = 0.0
    left: float = np.inf


@dataclass
class Origin:
    """A robot that can be left from.

    Attributes:
        alpha: (D,) where it is.
        policy, value: that a path had on it.
        noise: share of the exploration's standard deviation that the policy bears.
        route: names of the robots on the way to it, itself included.
    """

    alpha: np.ndarray
    policy: GaussianPolicy
    value: ValueFunction
    noise: float
    route: list[str]


class Asking:
    """The robots that can be left from, and what they answered.

    Args:
        metric: in which the rest of a way is measured.
        shares: of the way at which one looks, the farthest first.
        xi: the shortest leap, L2 [alpha].

    Attributes:
        origins: robots with a policy; the source is the first.
        leaps: target -> the best answer.
        asked: target -> robots that have answered.
        raced: targets to which a path from the source has been begun.
        corners: path -> what is left of its way [alpha] after the corner at which its own policy holds.
    """

    def __init__(self, metric: Metric, shares: Sequence[float], xi: float) -> None:
        self._metric, self._shares, self._xi = metric, shares, xi
        self.origins: list[Origin] = []
        self.leaps: dict[str, Leap] = {}
        self.asked: dict[str, int] = {}
        self.raced: list[str] = []
        self.corners: dict[str, float] = {}

    def offer(self, branch: Branch, route: Sequence[str]) -> None:
        """The robot where ``branch`` stands, at the end of that ``route``, can be left from by its policy."""
        self.origins.append(Origin(branch.alpha, branch.policy.copy(), branch.value.copy(), branch.noise, list(route)))

    def distance(self, start: np.ndarray, end: np.ndarray) -> float:
        """Between two robots (D,), in the metric."""
        return float(distances(start[None], end[None], self._metric)[0, 0])

    def best(self, branch: Branch, target: str, goal: np.ndarray, holds: Callable[[Branch, np.ndarray], bool]) -> Leap:
        """The leap that leaves the least of the way to a target; only robots that have not answered yet are looked at.

        Args:
            branch: whose path bears the cost of looking.
            target: its name.
            goal: (D,) where it is.
            holds: whether the policy of a branch holds on a robot (D,).
        """
        best = self.leaps.get(target, Leap())
        for index in range(self.asked.get(target, 0), len(self.origins)):
            origin = self.origins[index]
            probe = Branch(branch.path, origin.alpha, [target], origin.policy, origin.value, branch.ledger, branch.rng, noise=origin.noise)
            way, length = goal - origin.alpha, self.distance(origin.alpha, goal)
            for share in self._shares:
                left = (1.0 - share) * length
                if left >= best.left or share * np.linalg.norm(way) < self._xi:
                    break  # no nearer look of this robot's can be better
                if holds(probe, origin.alpha + share * way if share < 1.0 else goal):
                    best = Leap(index, share, left)
                    break
        self.leaps[target], self.asked[target] = best, len(self.origins)
        return best

    def left(self, branch: Branch, turn: np.ndarray | None, goal: np.ndarray, holds: Callable[[Branch, np.ndarray], bool]) -> float:
        """What the tree's own way leaves to ``goal`` (D,): from the corner ``turn`` (D,) on, if the branch's policy holds there already."""
        length = self.distance(branch.alpha, goal)
        if turn is None:
            return length
        if branch.path not in self.corners:
            self.corners[branch.path] = self.distance(turn, goal) if holds(branch, turn) else np.inf
        return min(length, self.corners[branch.path])

    def promise(self, branch: Branch, goal: np.ndarray, spent: int) -> float:
        """Training episodes that a branch's way to ``goal`` (D,) will still take, at the rate of the ``spent`` ones so far."""
        assert branch.began is not None
        left = self.distance(branch.alpha, goal)
        return left * (spent + 1) / max(branch.began - left, 1e-9)

    def tensors(self) -> dict[str, np.ndarray]:
        """Its arrays, for a checkpoint."""
        found: dict[str, np.ndarray] = {}
        for i, origin in enumerate(self.origins):
            found |= {f"origin.{i}.alpha": origin.alpha} | learner_tensors(f"origin.{i}", origin.policy, origin.value)
        return found

    def state(self) -> dict[str, Any]:
        """All else, as JSON values."""
        leaps = {target: asdict(leap) for target, leap in self.leaps.items() if leap.origin >= 0}
        origins = [{"noise": origin.noise, "route": origin.route} for origin in self.origins]
        return {"origins": origins, "leaps": leaps, "asked": dict(self.asked), "raced": list(self.raced),
                "corners": {path: left if np.isfinite(left) else None for path, left in self.corners.items()}}

    def restore(
        self, tensors: dict[str, np.ndarray], state: Mapping[str, Any], policy: GaussianPolicy, value: ValueFunction
    ) -> None:
        """Take up what `tensors` and `state` gave out; ``policy`` and ``value`` are networks of the same sizes."""
        self.origins = []
        for i, saved in enumerate(state["origins"]):
            origin = Origin(tensors[f"origin.{i}.alpha"], policy.copy(), value.copy(), saved["noise"], saved["route"])
            load_learner(tensors, f"origin.{i}", origin.policy, origin.value)
            self.origins.append(origin)
        self.asked, self.raced = state["asked"], state["raced"]
        self.corners = {path: np.inf if left is None else left for path, left in state["corners"].items()}
        self.leaps = {target: Leap(**leap) for target, leap in state["leaps"].items()}
