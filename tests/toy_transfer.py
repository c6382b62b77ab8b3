"""A transfer on a toy whose every number can be checked: three dimensions, one action, and a success that is measured.

The robot alpha succeeds if its action lies within a tolerance of `wanted(alpha)`, and only then is it rewarded, once.
Some seeds are harder than others, so that success is a rate: at an error of TOLERANCE none succeeds. The observation is
always the same, so a policy is one number, and the natural policy gradient has to move that number
along as the robots move: from 0.1 at the source to 0.96 at the meta robot, then to 1.36 or back to 0.47.
"""

import numpy as np

from tasks.sight import Sight
from toolkit.evolution import Terminal
from toolkit.learning.episode import Episode
from toolkit.learning.exploration import Explored
from toolkit.learning.npg import NpgConfig
from toolkit.learning.policy import GaussianPolicy, ValueFunction
from toolkit.runs.run import Run
from toolkit.runs.seeds import TRAINING_SEEDS
from toolkit.transfer.meta_evolve import Transfer
from toolkit.transfer.settings import TransferConfig

SOURCE = Terminal("hand", np.zeros(3))
TARGETS = [Terminal("left", np.array([0.8, 0.6, 0.2])), Terminal("right", np.array([0.8, 0.2, 0.9]))]
META = np.array([0.8, 0.2, 0.2])
WEIGHTS = np.array([1.0, 1.0, -0.7])
TOLERANCE = 0.15
OBSERVATION = np.ones(1)
TIMING = {"episodes_per_s", "play_s", "learn_s", "seconds"}
EXPLORED = Explored(np.array([0.2]), np.zeros(1))
NPG = NpgConfig(step_size=0.1, min_log_std=-2.6, cg_iterations=4, value_epochs=2)
THREE = [*TARGETS, Terminal("far", np.array([0.9, 0.1, 0.95]))]
"""Two of them part once more behind the first meta robot."""


def wanted(alpha):
    """The one action that the robot alpha (3,) should take."""
    return float(WEIGHTS @ alpha) + 0.1


def tolerance(seed):
    """How far from wanted an episode of this seed may act: 0.5 to 1 of TOLERANCE."""
    return TOLERANCE * (0.5 + 0.5 * (seed * 5 % 12 + 1) / 12)


def own(sight):
    """The observation (1,) of a robot's own that is seen as OBSERVATION."""
    return np.linalg.solve(sight.matrix, OBSERVATION - sight.constant)


class Killed(Exception):
    """What stands for a kill."""


class Toy:
    """Plays the toy, and writes down whom it played.

    Attributes:
        calls: (branch, training or not, alphas, seeds) per batch, the branch as it was when it asked.
        sight: alpha (3,) -> how that robot's own observation is seen for the toy's.
        episodes: played.
    """

    def __init__(self, kill_after=None, succeeds=True, shift=0.0, sight=None):
        self.kill_after, self.succeeds, self.shift = kill_after, succeeds, shift
        self.sight = sight or (lambda alpha: Sight.plain(1))
        self.calls, self.episodes, self.transfer, self.stopped = [], 0, None, False

    def play(self, actor, alphas, seeds):
        if self.kill_after is not None and len(self.calls) >= self.kill_after:
            raise Killed
        branch = self.transfer.pending[-1]
        actors = actor if isinstance(actor, list) else [actor] * len(seeds)
        noisy = len({float(actors[0](OBSERVATION, np.random.default_rng(i))[0]) for i in range(3)}) > 1
        state = {
            "path": branch.path, "alpha": branch.alpha, "next": branch.next_alpha, "window": branch.window,
            "stage": branch.stage, "training": max(seeds) < TRAINING_SEEDS, "noisy": noisy,
            "alphas": np.array(alphas), "seeds": list(seeds),
        }
        self.calls.append(state)
        self.episodes += len(seeds)
        return [self.one(*job) for job in zip(actors, alphas, seeds, strict=True)]

    def stop(self):
        self.stopped = True

    def one(self, actor, alpha, seed):
        observation = own(self.sight(alpha))
        action = actor(observation, np.random.default_rng((seed, 1)))
        success = self.succeeds and abs(float(action[0]) - wanted(alpha) - self.shift) < tolerance(seed)
        return Episode(
            observations=observation[None], actions=action[None], rewards=np.array([float(success)]), success=success,
            diverged=False, terminated=True, last_observation=observation, alpha=alpha, seed=seed,
        )

    def of(self, training):
        return [call for call in self.calls if call["training"] is training]


def easy_toy():
    """All its robots want what the source wants."""
    toy = Toy()
    toy.one = lambda actor, alpha, seed: Toy.one(toy, actor, np.zeros(3), seed)
    return toy


def expert():
    """A policy that succeeds on the source, and a value function."""
    rng = np.random.default_rng(5)
    policy = GaussianPolicy(["one"], ["a"], rng, hidden=(8,), init_log_std=-2.2)
    value = ValueFunction(["one"], rng, hidden=(8,))
    bias = policy.parameters.copy()
    bias[-2] += wanted(SOURCE.alpha) - float(policy.mean(OBSERVATION)[0])
    policy.set_parameters(bias)
    return policy, value


def seeing_expert():
    """As `expert`, but nearly linear in what it sees: an offset of its one observation moves its action by as much."""
    policy, value = expert()
    policy.set_parameters(np.concatenate([np.full(8, 0.1), np.zeros(8), np.full(8, 10 / 8), [0.0], policy.log_std]))
    policy.set_normalisation(policy.mean(OBSERVATION) - wanted(SOURCE.alpha), np.ones(1))
    return policy, value


def config(**changes):
    return TransferConfig(**{"npg": NPG, "check_episodes": 12, "goal_episodes": 12, "xi": 0.08, "native": False} | changes)


def natives(**settings):
    return {"left": Toy(shift=0.2, **settings), "right": Toy(shift=-0.2, **settings)}


def transfer_of(folder, settings, player, resume=False, targets=TARGETS, native=None, report=None, on_batch=None, bends=None,
                explored=EXPLORED, sight=None):
    """A Transfer in a run folder, and the run."""
    run = Run.open(folder, {}) if resume else Run.create(folder, {})
    native = {name: (lambda toy=toy: toy) for name, toy in (native or {}).items()}
    quiet = lambda *seen: None  # noqa: E731
    learner = expert() if settings.learner == "npg" else seeing_expert()
    transfer = Transfer(settings, SOURCE, list(targets), *learner, player, native, run, report or quiet, on_batch or quiet, explored,
                        bends, sight)
    for toy in (player, *(maker() for maker in native.values())):
        toy.transfer = transfer
    if resume:
        transfer.restore()
    return transfer


def records(transfer, event=None):
    return [r for r in transfer.run.read_metrics() if event in (None, r["event"])]


def error_at(policy, alpha):
    return abs(float(policy.mean(OBSERVATION)[0]) - wanted(alpha))


def share_on_segment(alphas, start, end):
    """Where alphas (N, 3) project onto the segment from start to end, as shares (N,), and how far they lie off it."""
    way = end - start
    if np.linalg.norm(way) < 1e-12:
        return np.ones(len(alphas)), np.linalg.norm(alphas - end, axis=1).max()
    shares = (alphas - start) @ way / (way @ way)
    return shares, np.linalg.norm(alphas - start - shares[:, None] * way, axis=1).max()


def timeless(transfer):
    return [{k: v for k, v in record.items() if k not in TIMING} for record in records(transfer)]


def assert_same_end(transfer, unbroken):
    assert timeless(transfer) == timeless(unbroken), "metrics.jsonl differs"
    for name, policy in unbroken.arrived.items():
        np.testing.assert_array_equal(transfer.arrived[name].parameters, policy.parameters, err_msg=name)
        for field in ("shift", "scale"):
            np.testing.assert_array_equal(getattr(transfer.arrived[name].layers(), field), getattr(policy.layers(), field))
    assert transfer.costs == unbroken.costs and transfer.routes == unbroken.routes
    assert set(transfer.arrived) == set(unbroken.arrived)
