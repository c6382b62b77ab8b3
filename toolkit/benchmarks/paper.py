"""The paper's own costs, beside which ours stand: means and standard deviations over five seeds (Liu et al. 2024).

Tables "One-to-three policy transfer experiment results on Hand Manipulation Suite tasks", "One-to-six policy transfer experiment results"
and, in its appendix, "One-to-three policy transfer experiment results on DexYCB manipulation task" (targets Jaco, Kinova3, IIWA).
"""

from dataclasses import dataclass

SEEDS = 5
"""Of each of the paper's rows."""


@dataclass(frozen=True)
class PaperRow:
    """A method's cost to all targets of a task.

    Attributes:
        method, task: as the paper calls them.
        train_iterations, sim_epochs: (mean, standard deviation), a simulation epoch being one training episode.
    """

    method: str
    task: str
    train_iterations: tuple[float, float]
    sim_epochs: tuple[float, float]


HERD, MEDIAN = "HERD, independent", "Meta-Evolve, L1 geometric median"
TWO, ONE = "Meta-Evolve, 2-Steiner tree", "Meta-Evolve, 1-Steiner tree"
PAPER: dict[str, tuple[PaperRow, ...]] = {
    "real-robots": (
        PaperRow(HERD, "DexYCB", (38437, 2883), (185825, 16731)),
        PaperRow(ONE, "DexYCB", (20081, 4509), (89924, 7962)),
    ),
    "hand": (
        PaperRow(HERD, "door", (4357, 395), (64296, 1289)),
        PaperRow(ONE, "door", (2046, 200), (23156, 1059)),
        PaperRow(HERD, "hammer", (23138, 4366), (143233, 20362)),
        PaperRow(MEDIAN, "hammer", (11851, 3487), (57696, 12549)),
        PaperRow(TWO, "hammer", (9186, 1127), (44431, 3908)),
        PaperRow(ONE, "hammer", (7843, 1380), (44333, 5459)),
        PaperRow(HERD, "relocate", (27109, 4209), (180712, 14465)),
        PaperRow(MEDIAN, "relocate", (12745, 2454), (57751, 9083)),
        PaperRow(TWO, "relocate", (16257, 2719), (71370, 11022)),
        PaperRow(ONE, "relocate", (11853, 766), (56969, 3750)),
    ),
    "ant": (
        PaperRow(HERD, "ant-maze", (14793, 163), (84931, 758)),
        PaperRow(ONE, "ant-maze", (6739, 721), (34925, 2893)),
    ),
}
"""Suite -> rows. DAPG, the paper's direct training, reached no target in 200 000 simulation epochs each."""
