"""The suites of runs that `bench transfer` plays, each beside a table of the paper."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from toolkit.cli.names import TARGETS, TASK, Method, Metric, find_robot, find_task

if TYPE_CHECKING:
    from toolkit.transfer.pipeline import Job


@dataclass(frozen=True)
class Entry:
    """A run of a suite: the options of `meta-evolve transfer` that tell it from the others."""

    kind: Method = "steiner"
    metric: Metric = "l1"
    step: Literal["adaptive", "fixed"] = "adaptive"
    path: Literal["straight", "bent", "optimised"] | None = None
    joints: Literal["measured", "retargeted"] | None = None
    xi: float | None = None
    budget: int | None = None
    seed: int = 0
    task: str = TASK
    source: str = "adroit"
    targets: tuple[str, ...] = TARGETS
    episodes: int = 20
    expert: str | None = None
    exploration: float | None = None
    learner: Literal["search", "npg"] | None = None
    goal: float | None = None
    firm: float | None = None
    enough: float | None = None
    preset: str | None = None

    def job(self, preset: str) -> "Job":
        """What `meta-evolve transfer` would play by its own preset, else by this one."""
        from toolkit.transfer.pipeline import Job, transfer_config

        overrides = {"step": self.step, "path": self.path, "joints": self.joints, "xi": self.xi, "path_budget": self.budget,
                     "learner": self.learner, "exploration": self.exploration, "goal": self.goal, "firm": self.firm,
                     "enough": self.enough}
        config = transfer_config(self.preset or preset, self.kind, self.metric, self.seed, **overrides)
        robots = tuple(find_robot(name) for name in self.targets)
        return Job(find_robot(self.source), robots, find_task(self.task), config, self.episodes, self.expert)


CAN, WIDE, JAWS = "010_potted_meat_can", f"{TASK}-wide", ("kinova3", "iiwa")  # the can is too wide for the Jaco's grasp
HANDS = Entry(expert=f"adroit-{TASK}-wide-recordings", exploration=0.15, episodes=60, learner="npg")
FOUND = replace(HANDS, exploration=None, learner="search", targets=TARGETS, episodes=200, budget=3_000)
ASIDE = replace(FOUND, episodes=60)
PLAIN = replace(ASIDE, learner="npg", exploration=HANDS.exploration, budget=5_000)  # per path: twice what the whole tree took at first
FOUND_CAN = replace(FOUND, task=CAN, expert=f"adroit-{CAN}-wide-recordings", targets=JAWS, episodes=100)
ALONE = replace(HANDS, kind="independent")
SIX = (*TARGETS, "panda", "ur5e", "sawyer")
PAPERS = Entry(step="fixed", preset="paper")
COARSE = 0.3
"""Fixed step: the paper's xi of 0.03 takes a thousand phases here, each of 16 checking episodes or more."""
REAL_ROBOTS: dict[str, Entry] = {
    # What is to be shipped, judged over the most seeds.
    "tree-0": Entry(episodes=200),
    "can-tree-0": Entry(task=CAN, targets=JAWS, budget=3_000, episodes=100),
    "can-independent-0": Entry(task=CAN, kind="independent", targets=JAWS, episodes=100),
    "tree-1": Entry(seed=1),
    "independent-0": Entry(kind="independent"),
    "direct-0": Entry(kind="direct"),
    # A start within 5 cm and 30 degrees: here the policy has to learn on the way.
    "wide-tree-0": Entry(task=WIDE, budget=1_500, episodes=60),
    "wide-independent-0": Entry(task=WIDE, kind="independent", budget=1_500),
    "wide-direct-0": Entry(task=WIDE, kind="direct", budget=1_500),
    # An expert that learned from recordings of hands, and grasps as they do: it succeeds on no target untrained. Kinova3 and
    # ur5e (the twins) carry one gripper, iiwa its larger sister (the jaws).
    "hands-tree-0": replace(HANDS, targets=(*JAWS, "jaco"), episodes=200),
    "hands-kinova3-0": replace(ALONE, targets=("kinova3",), episodes=200),
    "hands-iiwa-0": replace(ALONE, targets=("iiwa",)),
    "hands-jaco-0": replace(ALONE, targets=("jaco",)),
    "hands-ur5e-0": replace(ALONE, targets=("ur5e",)),
    "hands-panda-0": replace(ALONE, targets=("panda",)),
    "hands-sawyer-0": replace(ALONE, targets=("sawyer",)),
    "hands-twins-0": replace(HANDS, targets=("kinova3", "ur5e")),
    "hands-jaws-0": replace(HANDS, targets=("kinova3", "ur5e", "iiwa")),
    "hands-direct-0": replace(HANDS, kind="direct", budget=2_200, targets=("kinova3",)),
    # The same expert, by exploration held for an episode.
    **{f"found-tree-{seed}": replace(FOUND, seed=seed) for seed in range(3)},
    # Seeds from 3 on were played after the rule that asks was settled: no choice of it can have been made for them.
    **{f"found-independent-{seed}": replace(FOUND, seed=seed, kind="independent") for seed in range(6)},
    **{f"found-asking-{seed}": replace(FOUND, seed=seed, kind="asking") for seed in range(6)},
    # The same by plain NPG on the weights; direct: with the demonstrations' pull (DAPG).
    "plain-tree-0": PLAIN,
    "plain-independent-0": replace(PLAIN, kind="independent"),
    "plain-direct-0": replace(PLAIN, kind="direct", budget=1_000),
    # Two jaws that differ: a Robotiq 2F-85 and a 2F-140.
    **{f"found-jaws-{seed}": replace(FOUND, seed=seed, targets=JAWS) for seed in range(3)},
    **{f"found-jaws-independent-{seed}": replace(FOUND, seed=seed, targets=JAWS, kind="independent") for seed in range(3)},
    # What is compared with these, and how the cost grows with the number of arms, is about epochs more than about the last per cent.
    "found-direct-0": replace(ASIDE, kind="direct", budget=1_000),
    **{f"found-l2-{seed}": replace(ASIDE, seed=seed, metric="l2") for seed in range(3)},
    "found-median-0": replace(ASIDE, kind="geometric-median"),
    "found-optimised-0": replace(ASIDE, kind="independent", path="optimised"),
    "found-can-0": FOUND_CAN,
    "found-can-independent-0": replace(FOUND_CAN, kind="independent"),
    # The arms that the others leave out.
    **{f"found-grown-{count}": replace(ASIDE, targets=SIX[:count]) for count in (2, 4, 5, 6)},
    **{f"found-{name}-0": replace(ASIDE, kind="independent", targets=(name,)) for name in SIX[3:]},
    # Twice as many targets.
    "six-tree-0": Entry(targets=SIX),
    "six-independent-0": Entry(targets=SIX, kind="independent"),
    # The other trees and ways.
    "tree-l2-0": Entry(metric="l2"),
    "median-0": Entry(kind="geometric-median"),
    "median-l2-0": Entry(kind="geometric-median", metric="l2"),
    "independent-l2-0": Entry(kind="independent", metric="l2"),
    "optimised-0": Entry(path="optimised", step="fixed", xi=2.0, targets=JAWS),
    # The paper's schedule, coarser.
    "fixed-tree-0": Entry(step="fixed", xi=COARSE, budget=1_500),
    "fixed-independent-0": Entry(step="fixed", kind="independent", xi=COARSE, budget=1_500),
    "wide-fixed-tree-0": Entry(task=WIDE, step="fixed", xi=COARSE, budget=1_500),
    "wide-fixed-independent-0": Entry(task=WIDE, step="fixed", kind="independent", xi=COARSE, budget=1_500),
    "paper-tree-0": PAPERS,
    "paper-independent-0": replace(PAPERS, kind="independent"),
    "paper-hands-kinova3-0": replace(PAPERS, kind="independent", targets=("kinova3",), expert=HANDS.expert, episodes=200),
}
"""Run -> what it plays; the short ones first."""

FINGERS = ("two-finger", "three-finger", "four-finger")
BARELY = 2 / 3
"""Firmness of ways on which every step is short: whether they pay to be left more firmly was not measured."""
HAND = Entry(source="adroit-free", targets=FINGERS, episodes=200, learner="search", goal=0.9, firm=BARELY)  # the paper asks for 0.8
HAND_TASKS = ("door", "hammer", "relocate")


def _hand(task: str) -> dict[str, Entry]:
    """The paper's rows of one task; the Steiner tree and independent paths by three seeds."""
    entry = replace(HAND, task=task)
    return {
        **{f"{task}-tree-{seed}": replace(entry, seed=seed) for seed in range(3)},
        **{f"{task}-independent-{seed}": replace(entry, seed=seed, kind="independent") for seed in range(3)},
        f"{task}-l2-0": replace(entry, metric="l2"),
        f"{task}-median-0": replace(entry, kind="geometric-median"),
        f"{task}-asking-0": replace(entry, kind="asking"),
        f"{task}-direct-0": replace(entry, kind="direct"),
    }


HAND_SUITE: dict[str, Entry] = {
    **{name: entry for task in HAND_TASKS for name, entry in _hand(task).items()},
    "door-optimised-0": replace(HAND, task="door", kind="independent", path="optimised"),
    "door-plain-0": replace(HAND, task="door", learner="npg"),
    "door-plain-independent-0": replace(HAND, task="door", learner="npg", kind="independent"),
    "door-paper-0": replace(PAPERS, task="door", source="adroit-free", targets=FINGERS, episodes=200),
}
"""As REAL_ROBOTS, of the Hand Manipulation Suite."""

SIX_ANTS = tuple(f"ant-{count}" for count in range(1, 7))
ANT = Entry(source="ant", task="ant-maze", targets=SIX_ANTS, episodes=200, learner="search", goal=0.95, firm=BARELY, enough=0.9)
ANT_SUITE: dict[str, Entry] = {
    **{f"tree-{seed}": replace(ANT, seed=seed) for seed in range(3)},
    **{f"independent-{seed}": replace(ANT, seed=seed, kind="independent") for seed in range(3)},
    "b-tree-0": replace(ANT, targets=("ant-1b", *SIX_ANTS[1:])),
    "b-independent-0": replace(ANT, targets=("ant-1b", *SIX_ANTS[1:]), kind="independent"),
    "asking-0": replace(ANT, kind="asking"),
    "direct-0": replace(ANT, kind="direct", budget=750),  # 4500 for the six, what the trees cost
    "plain-0": replace(ANT, learner="npg"),
    "plain-independent-0": replace(ANT, learner="npg", kind="independent"),
    **{f"grown-{count}": replace(ANT, targets=SIX_ANTS[:count]) for count in range(1, 6)},
}
"""As REAL_ROBOTS, of ants in a maze; "b": one of the six ants is another, so that a meta robot shortens the tree."""


@dataclass(frozen=True)
class Suite:
    """Runs that belong into one table.

    Attributes:
        title: of their page.
        folder: where the run folders usually are; the page is <folder>.md.
        entries: run -> what it plays.
    """

    title: str
    folder: Path
    entries: dict[str, Entry]


SUITES: dict[str, Suite] = {
    "real-robots": Suite("Results on unmodified robosuite robots", Path("docs/results"), REAL_ROBOTS),
    "hand": Suite("Results on the Hand Manipulation Suite", Path("docs/results-hand"), HAND_SUITE),
    "ant": Suite("Results of ants in a maze", Path("docs/results-ant"), ANT_SUITE),
}
"""Suites by name, which are also those of the paper's tables (benchmarks/paper.py)."""
