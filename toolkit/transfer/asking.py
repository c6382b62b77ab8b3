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
from toolkit.learning.policy import GaussianPolicy, ValueFunction
from toolkit.transfer.branch import Branch, stored_branch


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


class Asking:
    """The robots that can be left from, and what they answered.

    Args:
        metric: in which the rest of a way is measured.
        shares: of the way at which one looks, the farthest first.
        xi: the shortest leap, L2 [alpha].

    Attributes:
        origins: robots with a policy, as branches that stand there.
        routes: names of the robots on the way to each, itself included.
        leaps: target -> the best answer.
        asked: target -> robots that have answered.
        raced: targets to which a path from the source has been begun.
        corners: path -> what is left of its way [alpha] after the corner at which its own policy holds.
    """

    def __init__(self, metric: Metric, shares: Sequence[float], xi: float) -> None:
        self._metric, self._shares, self._xi = metric, shares, xi
        self.origins: list[Branch] = []
        self.routes: list[list[str]] = []
        self.leaps: dict[str, Leap] = {}
        self.asked: dict[str, int] = {}
        self.raced: list[str] = []
        self.corners: dict[str, float] = {}

    def offer(self, branch: Branch, route: Sequence[str]) -> None:
        """The robot where ``branch`` stands can be left from, by its policy."""
        self.origins.append(Branch(branch.path, branch.alpha, [], branch.policy.copy(), branch.value.copy(), noise=branch.noise))
        self.routes.append(list(route))

    def distance(self, start: np.ndarray, end: np.ndarray) -> float:
        """Between two robots (D,), in the metric."""
        return float(distances(start[None], end[None], self._metric)[0, 0])

    def best(self, target: str, goal: np.ndarray, path: str, holds: Callable[[Branch, np.ndarray], bool]) -> Leap:
        """The leap that leaves the least of the way to a target; only robots that have not answered yet are looked at.

        Args:
            target: its name.
            goal: (D,) where it is.
            path: that bears the cost of looking.
            holds: whether the policy of a branch holds on a robot (D,).
        """
        best = self.leaps.get(target, Leap())
        for index in range(self.asked.get(target, 0), len(self.origins)):
            origin = self.origins[index]
            probe = Branch(path, origin.alpha, [target], origin.policy, origin.value, noise=origin.noise)
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
        return {key: array for i, origin in enumerate(self.origins) for key, array in origin.tensors(f"origin.{i}").items()}

    def state(self) -> dict[str, Any]:
        """All else, as JSON values."""
        leaps = {target: asdict(leap) for target, leap in self.leaps.items() if leap.origin >= 0}
        return {"origins": [origin.state() for origin in self.origins], "routes": self.routes, "leaps": leaps, "asked": self.asked,
                "raced": self.raced,
                "corners": {path: left if np.isfinite(left) else None for path, left in self.corners.items()}}  # fmt: skip

    def restore(
        self, tensors: dict[str, np.ndarray], state: Mapping[str, Any], policy: GaussianPolicy, value: ValueFunction
    ) -> None:
        """Take up what `tensors` and `state` gave out; ``policy`` and ``value`` are networks of the same sizes."""
        self.origins = [stored_branch(tensors, f"origin.{i}", saved, policy, value) for i, saved in enumerate(state["origins"])]
        self.routes, self.asked, self.raced = state["routes"], state["asked"], state["raced"]
        self.corners = {path: np.inf if left is None else left for path, left in state["corners"].items()}
        self.leaps = {target: Leap(**leap) for target, leap in state["leaps"].items()}
