"""The source expert: behaviour cloning of demonstrations, then natural policy gradient under the sparse reward."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tasks.pick import OBSERVATION
from tasks.task import Task
from toolkit.demonstrations.recorded import Recorded
from toolkit.demonstrations.scripts import PickScript, pick_script
from toolkit.demonstrations.tracks import TrackScript
from toolkit.errors import ToolkitError
from toolkit.learning.cloning import CloningConfig, clone
from toolkit.learning.npg import Demonstrations, NpgConfig, npg_step
from toolkit.learning.policy import GaussianPolicy, MeanActor, ValueFunction, learner_tensors, load_learner
from toolkit.morphology.build import MergedRobot
from toolkit.runs.generators import generator_from_state, generator_state
from toolkit.runs.run import Run
from toolkit.runs.seeds import DEMONSTRATION_SEEDS, EXPERT_SEEDS, VISIT_SEEDS
from toolkit.simulation.cluster import ClusterEngine
from toolkit.simulation.rollout import Engine, RolloutEngine

Script = PickScript | TrackScript
OBSERVATION_NOISE = OBSERVATION.numbers("noise")
"""Standard deviation (n_obs,) of the noise on copied observations, in each entry's own unit."""


@dataclass(frozen=True)
class ExpertConfig:
    """How the expert is trained."""

    demonstrations: int = 160
    """Scripted episodes; failed ones are dropped and counted."""
    noise: float = 0.12
    """Standard deviation of the noise that perturbs the demonstrated motion (the label stays the script's action), so
    that the clone learns to come back (Laskey et al. 2017, DART)."""
    copies: int = 4
    """Copies of the demonstrations with noisy observations, labelled by the script anew: the clone then knows what to do
    beside the demonstrated way, and judges a grasp by object and progress rather than by one hand's exact posture."""
    demonstrated_tolerance: float = 0.01
    """Distance [m] from the goal that demonstrations reach: tighter than the task, so that no clone stops short of it."""
    trials: int = 16
    """With several recorded demonstrations: episodes by which each is tried; the best one teaches."""
    rounds: int = 5
    """With recorded demonstrations: how often, at most, the clone plays, is told what its teacher would have done where it went,
    and is cloned again (Ross et al. 2011, DAgger)."""
    mastered: float = 1.0
    """Success in such a round at which there are no more."""
    visits: int = 40
    """Episodes of each such round: half under the policy's own noise, half by its mean action, which gets stuck elsewhere."""
    updates: int = 6
    """Natural-gradient updates after cloning."""
    seed: int = 0
    """Of everything random."""
    cloning: CloningConfig = field(default_factory=lambda: CloningConfig(epochs=40, init_log_std=-2.5))
    """Behaviour cloning."""
    imitation: CloningConfig = field(default_factory=lambda: CloningConfig(epochs=400, init_log_std=-2.5))
    """Behaviour cloning of steps from a file: nobody can be asked what to do beside them, so they are learned to the last digit."""
    npg: NpgConfig = field(default_factory=lambda: NpgConfig(step_size=0.005, batch_size=24))
    """The learner; larger steps than in transfer, as nothing is lost if the clone changes."""


def new_learner(task: Task, seed: int) -> tuple[GaussianPolicy, ValueFunction]:
    """A fresh policy and value function for a task's records."""
    rng = np.random.default_rng((seed, 7))
    policy = GaussianPolicy(task.observation.names, task.action.names, rng)
    return policy, ValueFunction(task.observation.names, rng)


class NoisyScript:
    """A script whose motion is perturbed; remembers what the script itself wanted at each observation."""

    def __init__(self, script: Script, noise: float) -> None:
        self.script, self.noise = script, noise

    def __call__(self, observation: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """The script's action with noise on the six OSC deltas and, weaker, on the fingers."""
        action = self.script(observation)
        action[:6] += self.noise * rng.standard_normal(6)
        action[6:] += 0.3 * self.noise * rng.standard_normal(action.size - 6)
        return action


def _with_noise(observations: np.ndarray, script: Script, copies: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The data (N, n_obs) with noisy copies, and what the script does at each (.., n_act)."""
    seen = np.tile(observations, (copies + 1, 1))
    seen[len(observations) :] += OBSERVATION_NOISE * rng.standard_normal((copies * len(observations), seen.shape[1]))
    return seen, np.array([script(observation) for observation in seen])


@dataclass(frozen=True, eq=False)
class _Dataset:
    """What is cloned: states (N, n_obs) that were seen and what the teacher does there (N, n_act).

    The first ``shown`` are the steps of the kept demonstrations; noisy copies and visited states follow.
    """

    seen: np.ndarray
    labels: np.ndarray
    shown: int

    def first(self, rows: int) -> "_Dataset":
        """The first rows alone."""
        return _Dataset(self.seen[:rows], self.labels[:rows], self.shown)


def _best_teacher(
    engine: Engine, beta: np.ndarray, config: ExpertConfig, teachers: Mapping[str, Script], report: Callable[[dict[str, Any]], None]
) -> str:
    """Name of the teacher that succeeds most often under noise, the quickest of equals; all play the same seeds.

    Only one is cloned, as a Gaussian policy that clones several learns their mean.
    """
    if len(teachers) == 1:
        return next(iter(teachers))
    seeds, marks = range(DEMONSTRATION_SEEDS, DEMONSTRATION_SEEDS + config.trials), {}
    for name, script in teachers.items():
        played = engine.play(NoisyScript(script, config.noise), [beta] * len(seeds), seeds)
        successes, steps = sum(episode.success for episode in played), float(np.mean([len(episode.rewards) for episode in played]))
        marks[name] = (-successes, steps)
        report({"event": "trial", "teacher": name, "played": len(seeds), "kept": successes, "steps": steps})
    return min(marks, key=lambda name: marks[name])


def _demonstrate(
    engine: Engine, beta: np.ndarray, config: ExpertConfig, script: Script, rng: np.random.Generator
) -> tuple[_Dataset | None, int]:
    """Play a teacher, keep what succeeds, label it; None if nothing does. Also how many episodes succeeded."""
    seeds = range(DEMONSTRATION_SEEDS, DEMONSTRATION_SEEDS + config.demonstrations)
    played = engine.play(NoisyScript(script, config.noise), [beta] * len(seeds), seeds)
    good = [episode.observations for episode in played if episode.success]
    if not good:
        return None, 0
    observations = np.concatenate(good)
    return _Dataset(*_with_noise(observations, script, config.copies, rng), len(observations)), len(good)


def _visit(
    engine: Engine, beta: np.ndarray, config: ExpertConfig, script: Script, policy: GaussianPolicy, dataset: _Dataset,
    round_: int, rng: np.random.Generator,
) -> tuple[_Dataset, float]:
    """Let the clone play, add what the teacher would have done where it went (Ross et al. 2011, DAgger); its success."""
    first, half = VISIT_SEEDS + round_ * config.visits, config.visits // 2
    seeds = list(range(first, first + config.visits))
    mean = MeanActor(policy)
    played = engine.play(mean, [beta] * half, seeds[:half]) + engine.play(policy.act, [beta] * (config.visits - half), seeds[half:])
    states, wanted = _with_noise(np.concatenate([episode.observations for episode in played]), script, 1, rng)
    more = replace(dataset, seen=np.concatenate([dataset.seen, states]), labels=np.concatenate([dataset.labels, wanted]))
    return more, float(np.mean([episode.success for episode in played]))


def train_expert(
    engine: RolloutEngine | ClusterEngine,
    source: str,
    config: ExpertConfig,
    report: Callable[[dict[str, Any]], None] = lambda record: None,
    teachers: Callable[[], tuple[Mapping[str, Script], dict[str, int]]] | None = None,
    run: Run | None = None,
) -> tuple[GaussianPolicy, ValueFunction, dict[str, Any]]:
    """Demonstrate, clone, improve on F(beta_0).

    Args:
        engine: plays the merged robot in its task.
        source: the robot that is F(beta_0).
        config: how.
        report: called with every event.
        teachers: gives scripts by the recordings that they follow, of which the best teaches, and counts of what became of the
            recordings; asked only if cloning is still to be done. Its demonstrations also pull the updates (DAPG). None: the script that
            is written for the object, and updates by reward alone.
        run: keeps events and, after every cloning and every update, everything that is needed to go on; a run that has a
            checkpoint is continued.

    Returns:
        policy, value function, and statistics.

    Raises:
        ToolkitError: no demonstration succeeds.
    """
    rng = np.random.default_rng(config.seed)
    beta = engine.merged.space.beta(source)
    policy, value = new_learner(engine.merged.task, config.seed)
    training = _Training(engine, engine.merged.task, beta, config, policy, value, rng, teachers is not None, report, run)
    training.restore()
    if not training.cloned:
        scripts, counts = ({"script": pick_script(arms_of(engine).task.object)}, {}) if teachers is None else teachers()
        training.clone(source, scripts, counts)
    while training.updates < config.updates:
        training.update()
    return policy, value, training.card


def imitate(
    engine: Engine,
    config: ExpertConfig,
    recorded: Recorded,
    report: Callable[[dict[str, Any]], None] = lambda record: None,
    run: Run | None = None,
) -> tuple[GaussianPolicy, ValueFunction, dict[str, Any]]:
    """Clone recorded steps, then improve on the robot itself, pulled by them (DAPG).

    Args:
        engine: plays the unmodified robot in its task.
        config: how; of the episodes recorded, the first ``demonstrations`` teach.
        recorded: what was shown in this task.
        report: called with every event.
        run: as for ``train_expert``.

    Returns:
        policy, value function, and statistics.
    """
    rng = np.random.default_rng(config.seed)
    policy, value = new_learner(engine.task, config.seed)
    training = _Training(engine, engine.task, np.zeros(1), config, policy, value, rng, True, report, run)
    training.restore()
    if not training.cloned:
        training.imitate(recorded)
    while training.updates < config.updates:
        training.update()
    return policy, value, training.card


def arms_of(engine: Any) -> MergedRobot:
    """The merged robot of arms with grippers on which an engine (RolloutEngine, ClusterEngine) plays.

    Raises:
        ToolkitError: it plays on other robots.
    """
    merged = getattr(engine, "merged", None)
    if not isinstance(merged, MergedRobot):
        raise ToolkitError("scripts and recordings of hands teach merged arms with grippers alone; give an engine of such robots")
    return merged


class _Training:
    """The state of an expert's training; every change of it ends in a checkpoint."""

    def __init__(
        self, engine: Engine, task: Task, beta: np.ndarray, config: ExpertConfig,
        policy: GaussianPolicy, value: ValueFunction, rng: np.random.Generator, recorded: bool,
        report: Callable[[dict[str, Any]], None], run: Run | None,
    ) -> None:
        self.engine, self.task, self.beta, self.config, self.recorded = engine, task, beta, config, recorded
        self.policy, self.value, self.rng, self.run = policy, value, rng, run
        self._report, self._records = report, 0
        self.updates, self.rounds, self.cloned = 0, 0, False
        self.card: dict[str, Any] = {}
        self.dataset: _Dataset | None = None

    def report(self, record: dict[str, Any]) -> None:
        """Tell whoever watches, and the run."""
        self._report(record)
        if self.run is not None:
            self.run.append_metrics(record)
            self._records += 1

    def clone(self, source: str, scripts: Mapping[str, Script], counts: dict[str, int]) -> None:
        """Demonstrations, behaviour cloning, and rounds of visiting with a recorded teacher; from where the run was left."""
        dataset = self._first_dataset(source, scripts, counts) if self.dataset is None else self.dataset
        if self.recorded:
            self._visits(scripts[self.card["teacher"]], dataset)
            self.cloned = True
            self.checkpoint()

    def _first_dataset(self, source: str, scripts: Mapping[str, Script], counts: dict[str, int]) -> _Dataset:
        """Choose the teacher, let it demonstrate, clone it."""
        config = self.config
        engine = self.engine.at(replace(arms_of(self.engine).task, goal_tolerance=config.demonstrated_tolerance))
        name = _best_teacher(engine, self.beta, config, scripts, self.report)
        dataset, kept = _demonstrate(engine, self.beta, config, scripts[name], self.rng)
        engine.close()
        self.report({"event": "demonstrations", "played": config.demonstrations, "kept": kept})
        if dataset is None:
            kind = "recorded" if self.recorded else "scripted"
            raise ToolkitError(f"none of {config.demonstrations} {kind} demonstrations succeeds on {source}; check its grasp posture")
        self.card = {"demonstrations_kept": kept, "demonstrations": config.demonstrations, **counts}
        if self.recorded:
            self.card["teacher"] = name
        self.cloned = not self.recorded
        self._learn(dataset, config.cloning)
        return dataset

    def imitate(self, recorded: Recorded) -> None:
        """Clone the steps of a file's first episodes as they are."""
        rows, kept = int(recorded.lengths[: self.config.demonstrations].sum()), min(len(recorded.lengths), self.config.demonstrations)
        self.report({"event": "demonstrations", "played": len(recorded.lengths), "kept": kept})
        self.card = {"demonstrations_kept": kept, "demonstrations": self.config.demonstrations, "steps": rows}
        self.dataset = _Dataset(recorded.observations[:rows], recorded.actions[:rows], rows)
        self._fit(self.dataset, self.config.imitation)
        if self.run is not None:
            self._save_dataset(self.run, self.dataset)  # before the checkpoint that counts on them
        self.cloned = True
        self.checkpoint()

    def _visits(self, script: Script, dataset: _Dataset) -> None:
        """The clone plays and its teacher says what it would have done, until the clone has mastered the task."""
        config = self.config
        again = replace(config.cloning, epochs=-(-config.cloning.epochs // 2))  # the clone goes on from where it is
        while self.rounds < config.rounds:
            round_ = self.rounds + 1
            dataset, success = _visit(self.engine, self.beta, config, script, self.policy, dataset, round_, self.rng)
            self.report({"event": "visits", "round": round_, "success": success, "played": config.visits})
            if success >= config.mastered:
                break
            self.rounds = round_
            self._learn(dataset, again)

    def _learn(self, dataset: _Dataset, config: CloningConfig) -> None:
        self._fit(dataset, config)
        self.dataset = dataset
        self.checkpoint()

    def _fit(self, dataset: _Dataset, config: CloningConfig) -> None:
        seen = lambda epoch, loss: self.report({"event": "cloning", "epoch": epoch, "of": config.epochs, "loss": loss})  # noqa: E731
        floor = self.task.observation.numbers("scale")
        losses = clone(self.policy, dataset.seen, dataset.labels, config, self.rng, scale_floor=floor, progress=seen)
        self.card["cloning_loss"] = losses[-1]

    def update(self) -> None:
        """One update under the sparse reward, pulled by demonstrations if there are recorded ones."""
        size = self.config.npg.batch_size
        first = EXPERT_SEEDS + self.updates * size
        batch = self.engine.play(self.policy.act, [self.beta] * size, list(range(first, first + size)))
        statistics = npg_step(self.policy, self.value, batch, self.config.npg, self.rng, self._demonstrations())
        success = float(np.mean([episode.success for episode in batch]))
        self.report({"event": "update", "update": self.updates, "success": success, **statistics})
        self.updates += 1
        self.checkpoint()

    def _demonstrations(self) -> Demonstrations | None:
        """What pulls the next update: a recorded teacher's kept demonstrations."""
        if not self.recorded or self.dataset is None:
            return None
        shown = self.dataset.first(self.dataset.shown)
        return Demonstrations(shown.seen, shown.labels, self.updates)

    def checkpoint(self) -> None:
        """Everything that is needed to go on: the learner in one atomic file, and beside it what it learns from.

        Lessons only grow until the clone is done, and are written first: those that the learner has seen are their first rows,
        wherever the process is killed.
        """
        if self.run is None:
            return
        dataset = self.dataset if self.recorded else None
        if dataset is not None and not self.cloned:
            self._save_dataset(self.run, dataset)
        state = {"updates": self.updates, "rounds": self.rounds, "cloned": self.cloned, "card": self.card,
                 "rows": 0 if dataset is None else len(dataset.seen), "rng": generator_state(self.rng),
                 "records": self._records}
        self.run.save_checkpoint("expert", learner_tensors("expert", self.policy, self.value), state)
        if dataset is not None and self.cloned and self.updates == 0:
            self._save_dataset(self.run, dataset.first(dataset.shown))  # all that updates need

    @staticmethod
    def _save_dataset(run: Run, dataset: _Dataset) -> None:
        run.save_checkpoint("lessons", {"seen": dataset.seen, "labels": dataset.labels}, {"shown": dataset.shown})

    def restore(self) -> None:
        """Go on from the run's checkpoint, if it has one."""
        if self.run is None:
            return
        if "expert" not in self.run.checkpoints():
            self.run.truncate_metrics(0)
            return
        try:
            self._take_up(*self.run.load_checkpoint("expert"))
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise ToolkitError(f"the checkpoint in {self.run.path} is damaged, or of another version ({error!r}); start a new run under "
                               "another --run") from None
        self.run.truncate_metrics(self._records)

    def _take_up(self, tensors: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        load_learner(tensors, "expert", self.policy, self.value)
        self.updates, self.rounds, self.cloned = state["updates"], state["rounds"], state["cloned"]
        self.card, self._records = state["card"], state["records"]
        self.rng.bit_generator.state = generator_from_state(state["rng"]).bit_generator.state
        if self.recorded and self.run is not None:
            arrays, kept = self.run.load_checkpoint("lessons")
            self.dataset = _Dataset(arrays["seen"], arrays["labels"], kept["shown"]).first(state["rows"])
