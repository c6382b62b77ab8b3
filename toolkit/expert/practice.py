"""An expert that learns from nothing, by the progress that its task measures.

    practice   an easier task, by natural policy gradient (an ant: to run on an open floor)
    looking on a new policy is cloned from the first one's mean, guided through the task, and then from what that would have done wherever
               the clone went (Ross et al. 2011, DAgger)
    the task   natural policy gradient, from starts all over the way; its guide still pulls, less with every update (DAPG)

Progress is rewarded on the source alone, as other experts are given demonstrations; a transfer has nothing but success.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from robots.model_robot import ModelRobot
from tasks.task import ModelTask, PractisedTask
from toolkit.errors import ToolkitError
from toolkit.learning.cloning import CloningConfig, clone
from toolkit.learning.episode import Episode
from toolkit.learning.npg import Demonstrations, NpgConfig, npg_step
from toolkit.learning.policy import GaussianPolicy, MeanActor, ValueFunction, learner_tensors, load_learner
from toolkit.runs.generators import generator_from_state, generator_state
from toolkit.runs.run import Run
from toolkit.runs.seeds import DEMONSTRATION_SEEDS, EXPERT_SEEDS, VISIT_SEEDS
from toolkit.simulation.rollout import Actor, NativeEngine


@dataclass(frozen=True)
class PracticeConfig:
    """How the expert is trained."""

    practice: int = 300
    """Natural-gradient updates on the easier task."""
    shown: int = 80
    """Guided episodes that the clone begins from."""
    rounds: int = 5
    """How often the clone plays, is told what its guide would have done where it went, and is cloned again."""
    visits: int = 48
    """Episodes of each such round, every second one under noise."""
    updates: int = 300
    """Natural-gradient updates on the task."""
    effort: float = 0.001
    """What a step costs per squared action, in the task's unit of progress."""
    fall: float = 1.0
    """What an episode costs that becomes hopeless, in the task's unit of progress."""
    noise: float = 0.15
    """Standard deviation of the noise on what the guide does."""
    seed: int = 0
    """Of everything random."""
    cloning: CloningConfig = field(default_factory=lambda: CloningConfig(epochs=40, init_log_std=-1.8))
    """Behaviour cloning; half as many epochs again in each round."""
    first: NpgConfig = field(default_factory=lambda: NpgConfig(
        gamma=0.99, gae_lambda=0.95, step_size=0.1, batch_size=32, min_log_std=-1.8, value_epochs=3, value_minibatch=128))
    """The learner of the easier task; its value function looks no further ahead than some seconds, as progress is rewarded at once."""
    npg: NpgConfig = field(default_factory=lambda: NpgConfig(
        gamma=0.99, gae_lambda=0.95, step_size=0.1, batch_size=48, min_log_std=-1.8, value_epochs=3, value_minibatch=128,
        demonstration_weight=0.1, demonstration_decay=0.98))
    """The learner of the task itself."""

    def __post_init__(self) -> None:
        for name, least in (("practice", 1), ("shown", 1), ("rounds", 0), ("visits", 2), ("updates", 0), ("seed", 0)):
            if getattr(self, name) < least:
                raise ToolkitError(f"PracticeConfig.{name} is {getattr(self, name)}; give at least {least}")


def practise(
    robot: ModelRobot,
    task: PractisedTask,
    config: PracticeConfig,
    report: Callable[[dict[str, Any]], None] = lambda record: None,
    run: Run | None = None,
    threads: int | None = None,
) -> tuple[GaussianPolicy, ValueFunction, dict[str, Any]]:
    """Learn a task from nothing, on the unmodified robot.

    Args:
        robot: the source.
        task: what it shall do.
        config: how.
        report: called with every event.
        run: keeps events and, after every update and every cloning, everything that is needed to go on; a run that has a checkpoint is
            continued.
        threads: that play; default: the machine's cores.

    Returns:
        policy, value function, and statistics.
    """
    learning = _Learning(robot, task, config, report, run, threads)
    learning.restore()
    while learning.practised < config.practice:
        learning.practise()
    while learning.rounds <= config.rounds:
        learning.look_on()
    while learning.updates < config.updates:
        learning.improve()
    learning.close()
    return learning.policy, learning.value, learning.card()


class _Learning:
    """The state of the learning; every change of it ends in a checkpoint.

    Attributes:
        runner, runner_value: of the easier task.  policy, value: of the task.
        practised, rounds, updates: how much was done; the first round is the cloning of the guided episodes.
        steps: of the policy that were played.
    """

    def __init__(
        self, robot: ModelRobot, task: PractisedTask, config: PracticeConfig, report: Callable[[dict[str, Any]], None], run: Run | None,
        threads: int | None,
    ) -> None:
        self.task, self.config, self.report_to, self.run = task, config, report, run
        self.easier, self.anywhere = task.practice(), task.scattered()
        self.engines = {id(what): NativeEngine(robot, what, threads) for what in (self.easier, self.anywhere)}
        self.rng = np.random.default_rng((config.seed, 7))
        self.runner, self.runner_value = self._networks(config_log_std=-1.0)
        self.policy, self.value = self._networks(config_log_std=config.cloning.init_log_std)
        self.practised = self.rounds = self.updates = self.steps = 0
        self.seen, self.labels = np.zeros((0, len(task.observation.names))), np.zeros((0, len(task.action.names)))
        self._records = 0

    def _networks(self, config_log_std: float) -> tuple[GaussianPolicy, ValueFunction]:
        names = self.task.observation.names
        return GaussianPolicy(names, self.task.action.names, self.rng, init_log_std=config_log_std), ValueFunction(names, self.rng)

    def close(self) -> None:
        """Stop the engines' workers."""
        for engine in self.engines.values():
            engine.close()

    def report(self, record: dict[str, Any]) -> None:
        """Tell of an event and keep it."""
        if self.run is not None:
            self.run.append_metrics(record)
            self._records += 1
        self.report_to(record)

    def card(self) -> dict[str, Any]:
        """What the expert's card says of its learning."""
        return {"policy_steps": self.steps, "practice_updates": self.practised, "rounds": self.rounds - 1, "updates": self.updates}

    def play(self, task: ModelTask, actor: Actor, first: int, count: int) -> list[Episode]:
        """Episodes of seeds from ``first`` on."""
        played = self.engines[id(task)].play(actor, [np.zeros(1)] * count, range(first, first + count))
        self.steps += sum(episode.steps for episode in played)
        return played

    def rewarded(self, task: ModelTask, episode: Episode) -> Episode:
        """The episode, rewarded by progress."""
        if episode.diverged:
            return episode
        seen = np.vstack([episode.observations, episode.last_observation])
        rewards = task.gains(seen) - self.config.effort * np.square(np.clip(episode.actions, -1.0, 1.0)).sum(axis=1)
        rewards[-1] -= self.config.fall * (episode.terminated and not episode.success)
        return replace(episode, rewards=rewards)

    def practise(self) -> None:
        """One update on the easier task; before the first, the scale of what is seen there is measured."""
        config, size, first = self.config, self.config.first.batch_size, EXPERT_SEEDS + self.practised * self.config.first.batch_size
        if self.practised == 0:
            seen = np.concatenate([e.observations for e in self.play(self.easier, self.runner.act, VISIT_SEEDS, size) if not e.diverged])
            scale = np.maximum(seen.std(axis=0), self.task.observation.numbers("scale"))
            for network in (self.runner, self.runner_value):
                network.set_normalisation(seen.mean(axis=0), scale)
        batch = [self.rewarded(self.easier, e) for e in self.play(self.easier, self.runner.act, first, size)]
        statistics = npg_step(self.runner, self.runner_value, batch, config.first, self.rng)
        gained = sum(float(e.rewards.sum()) for e in batch) / sum(e.steps for e in batch)
        self.report({"event": "practice", "update": self.practised, "of": config.practice, "reward_per_step": gained, **statistics})
        self.practised += 1
        self.checkpoint()

    @property
    def guide(self) -> Callable[[np.ndarray], np.ndarray]:
        """What the runner would do, guided through the task: observations (N, n_obs) -> actions (N, n_act)."""
        guided = self.task.guided(self.runner.mean)
        return lambda seen: np.clip(guided(seen), -1.0, 1.0)

    def look_on(self) -> None:
        """The guide plays and is cloned; or the clone plays, and is cloned again with what its guide would have done there."""
        config, guide = self.config, self.guide
        if self.rounds == 0:
            noisy = lambda seen, rng: guide(seen[None])[0] + config.noise * rng.standard_normal(self.labels.shape[1])  # noqa: E731
            played = self.play(self.anywhere, noisy, DEMONSTRATION_SEEDS, config.shown)
        else:
            first, half = VISIT_SEEDS + self.rounds * config.visits + config.first.batch_size, config.visits // 2
            played = self.play(self.anywhere, MeanActor(self.policy), first, half)
            played += self.play(self.anywhere, self.policy.act, first + half, config.visits - half)
        played = [episode for episode in played if not episode.diverged]
        met = np.concatenate([episode.observations for episode in played])
        self.seen, self.labels = np.concatenate([self.seen, met]), np.concatenate([self.labels, guide(met)])
        cloning = config.cloning if self.rounds == 0 else replace(config.cloning, epochs=-(-config.cloning.epochs // 2))
        losses = clone(self.policy, self.seen, self.labels, cloning, self.rng, scale_floor=self.task.observation.numbers("scale"))
        layers = self.policy.layers()
        self.value.set_normalisation(layers.shift.copy(), layers.scale.copy())
        success = float(np.mean([episode.success for episode in played]))
        self.report({"event": "looking on", "round": self.rounds, "of": config.rounds, "success": success, "loss": losses[-1]})
        self.rounds += 1
        self.checkpoint()

    def improve(self) -> None:
        """One update on the task, from starts all over the way."""
        config, size = self.config, self.config.npg.batch_size
        first = EXPERT_SEEDS + (config.practice + 1) * config.first.batch_size + self.updates * size
        batch = [self.rewarded(self.anywhere, e) for e in self.play(self.anywhere, self.policy.act, first, size)]
        met = np.concatenate([e.observations for e in batch if not e.diverged])
        statistics = npg_step(self.policy, self.value, batch, config.npg, self.rng, Demonstrations(met, self.guide(met), self.updates))
        success = float(np.mean([e.success for e in batch]))
        self.report({"event": "update", "update": self.updates, "success": success, **statistics})
        self.updates += 1
        self.checkpoint()

    def checkpoint(self) -> None:
        """Everything that is needed to go on: the learners in one atomic file, and beside it what the clone learns from.

        What it learns from only grows, and is written first: what the learner has seen are its first rows, wherever the process is killed.
        """
        if self.run is None:
            return
        if self.updates == 0 and self.rounds > 0:
            self.run.save_checkpoint("lessons", {"seen": self.seen, "labels": self.labels}, {})
        tensors = learner_tensors("runner", self.runner, self.runner_value) | learner_tensors("expert", self.policy, self.value)
        state = {"practised": self.practised, "rounds": self.rounds, "updates": self.updates, "steps": self.steps, "rows": len(self.seen),
                 "rng": generator_state(self.rng), "records": self._records}
        self.run.save_checkpoint("expert", tensors, state)

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
        load_learner(tensors, "runner", self.runner, self.runner_value)
        load_learner(tensors, "expert", self.policy, self.value)
        self.practised, self.rounds, self.updates = state["practised"], state["rounds"], state["updates"]
        self.steps, self._records = state["steps"], state["records"]
        self.rng.bit_generator.state = generator_from_state(state["rng"]).bit_generator.state
        if self.rounds > 0:
            arrays, _ = self.run.load_checkpoint("lessons")
            self.seen, self.labels = arrays["seen"][: state["rows"]], arrays["labels"][: state["rows"]]
