"""What determines a transfer: TransferConfig."""

import math
from dataclasses import dataclass, field
from typing import Literal

from toolkit.errors import ToolkitError
from toolkit.evolution import KINDS, METRICS, Kind, Metric
from toolkit.learning.exploration import SearchConfig
from toolkit.learning.npg import NpgConfig

Method = Kind | Literal["asking", "direct"]
METHODS: tuple[Method, ...] = (*KINDS, "asking", "direct")
Bending = Literal["straight", "bent", "optimised"]
PATHS: tuple[Bending, ...] = ("straight", "bent", "optimised")
Joints = Literal["measured", "retargeted"]
JOINTS: tuple[Joints, ...] = ("measured", "retargeted")
Learner = Literal["search", "npg"]
LEARNERS: tuple[Learner, ...] = ("search", "npg")


@dataclass(frozen=True)
class TransferConfig:
    """What determines a transfer; "paper" marks values of its hyperparameter table."""

    kind: Method = "steiner"
    """Evolution tree: "steiner", "geometric-median" (one meta robot) or "independent" (one path per target: HERD, REvolveR).
    "asking" takes the shortest tree as its guess, and leaves from whichever robot's policy holds nearest to a target.
    "direct" has no evolution: the expert is trained on every target itself from the start, pulled by what it did on the
    source (DAPG)."""
    metric: Metric = "l1"
    """Distance between robots."""
    seed: int = 0
    """Of everything random."""
    step: Literal["adaptive", "fixed"] = "adaptive"
    """"fixed": steps of length xi (paper). "adaptive": the farthest robot on which the policy still holds."""
    xi: float = 0.03
    """Evolution step, L2 (paper); adaptive: the shortest step tried."""
    path: Bending = "straight"
    """"straight": to the meta robot (REvolveR). "bent": turned, on edges where robots in between can do less than both
    ends when all parameters go at once; no longer in L1. "optimised": also where the expected return grows (HERD; Algorithm 1, line 4)."""
    joints: Joints = "measured"
    """Finger joints as a policy sees them: "measured": as they are, 0 where a robot has none (the paper's). "retargeted": where the
    source's would be at that progress of closing."""
    pull: float = 1.0
    """Weight lambda of the meta robot in the direction of an optimised path (paper)."""
    demonstrations: int = 12
    """Episodes of the expert on the source whose successes pull the updates of "direct"; 0: none. Not counted, as given data."""
    jacobian_episodes: int = 72
    """Robots sampled, at distance xi, for the Jacobian of the expected return; one training episode each (paper)."""
    learner: Learner = "npg"
    """"npg": the natural policy gradient on the weights alone (paper). "search": first an offset of what the policy sees, held for an
    episode and moved to what succeeds; the weights' turn comes where that brings no more (adaptive steps only)."""
    patience: int = 4
    """Search: measurements in a phase without a better success after which the other learner's turn comes, or another robot is tried."""
    exploration: float | None = None
    """Standard deviation of every action's noise when the transfer begins, which training then changes; None: the expert's own."""
    threshold: float = 2 / 3
    """Success rate of the mean action for moving on (paper: 66.7 %)."""
    firm: float = 2 / 3
    """Search: success to which a robot on the way is trained before it is left, if it has to be trained for; what holds barely has to be
    trained again a little farther on, and behind every fork anew."""
    noisy_threshold: float = 1 / 2
    """NPG: success rate under the noise of training for moving on: what trains next learns from such successes. Search: measured success
    from which the weights have their turn on a robot before a nearer one is tried."""
    signal: float = 1 / 8
    """NPG: success rate under the noise of training from which there is enough to learn from; adaptive: where training begins. The
    window's other robots are nearer, and succeed more often. Search: measured success above which a robot is trained for that was only
    looked at."""
    calm: float = 0.8
    """NPG, adaptive: factor on the noise where the mean action holds and the exploring policy does not; 1: the noise is left to
    training."""
    least_noise: float = 1 / 4
    """NPG, adaptive: share of its first standard deviation below which the noise is not calmed."""
    goal: float = 0.85
    """Success rate at which training on a target ends; a little above the paper's, which is judged apart."""
    enough: float = 0.8
    """Success rate that a policy trained to the goal has to show on starts by which it was not chosen; search: with which a target is left
    if no turn brings more (the paper's 80 %; 90 % of ants)."""
    shrink: float = 0.995
    """NPG: factor by which the sampling window closes in on the next robot, per update (paper)."""
    check_episodes: int = 24
    """Episodes of one measurement of success on the way (upstream: 24)."""
    goal_episodes: int = 40
    """Episodes of one measurement of success at a target."""
    check_every: int = 4
    """NPG: updates between two measurements in a phase; the search measures after every one."""
    allowance: int = 64
    """Asking: training episodes of a path to a target after which another sets out from the source; they take turns by what each promises
    still to cost, for twice as many every time."""
    path_budget: int = 20_000
    """Simulation epochs after which a path goes on to its end untrained; what it then reaches is measured, not assumed."""
    native: bool = True
    """Whether each path ends with the last hop to the unmodified robosuite robot."""
    npg: NpgConfig = field(default_factory=NpgConfig)
    """The natural policy gradient."""
    search: SearchConfig = field(default_factory=SearchConfig)
    """The search of an offset."""

    def __post_init__(self) -> None:
        for name, low, high in (("threshold", 0, 1), ("firm", 0, 1), ("noisy_threshold", 0, 1), ("signal", 0, 1), ("goal", 0, 1),
                                ("enough", 0, 1), ("shrink", 0, 1), ("calm", 0, 1), ("least_noise", 0, 1), ("xi", 0, math.inf)):
            value = getattr(self, name)
            if not low < value <= high:
                raise ToolkitError(f"transfer's {name} is {value}; give a number in ({low}, {high}]")
        if self.exploration is not None and not 0 < self.exploration < math.inf:
            raise ToolkitError(f"transfer's exploration is {self.exploration}; give a positive number, or none for the expert's own")
        if not 0 < self.pull < math.inf:
            raise ToolkitError(f"transfer's pull is {self.pull}; give a positive number")
        for name, low in (("check_episodes", 1), ("goal_episodes", 1), ("check_every", 1), ("path_budget", 0), ("seed", 0),
                          ("jacobian_episodes", 2), ("demonstrations", 0), ("patience", 1), ("allowance", 1)):
            if getattr(self, name) < low:
                raise ToolkitError(f"transfer's {name} is {getattr(self, name)}; give at least {low}")
        for name, known in (("step", ("fixed", "adaptive")), ("path", PATHS), ("joints", JOINTS), ("kind", METHODS), ("metric", METRICS),
                            ("learner", LEARNERS)):
            if getattr(self, name) not in known:
                raise ToolkitError(f"transfer's {name} is {getattr(self, name)!r}; there are: {', '.join(known)}")
        if self.learner == "search" and self.step == "fixed":
            raise ToolkitError("transfer's learner is 'search', which goes with adaptive steps; give learner 'npg' for fixed ones")

    @property
    def tree_kind(self) -> Kind:
        """The evolution tree that the method follows, or begins with; without evolution the targets share nothing."""
        if self.kind == "asking":
            return "steiner"
        return "independent" if self.kind == "direct" else self.kind
