"""An expert that learns from nothing, by the progress that its task measures: on an easier task first, then on its own.

Both by natural policy gradient. Progress is rewarded on the source alone, as other experts are given demonstrations; a transfer has nothing
but success.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tasks.task import PractisedTask
from toolkit.errors import ToolkitError
from toolkit.learning.episode import Episode
from toolkit.learning.npg import NpgConfig, npg_step
from toolkit.learning.policy import GaussianPolicy, MeanActor, ValueFunction, learner_tensors, load_learner
from toolkit.runs.generators import generator_from_state, generator_state
from toolkit.runs.run import Run
from toolkit.runs.seeds import CHECKING_SEEDS, EXPERT_SEEDS, VISIT_SEEDS
from toolkit.simulation.rollout import Engine


@dataclass(frozen=True)
class PracticeConfig:
    """How the expert is trained."""

    practice: int = 400
    """Natural-gradient updates on the easier task."""
    updates: int = 600
    """Natural-gradient updates on the task at most, from starts all over the way."""
    check_every: int = 25
    """Updates on the task between two measurements of the mean action's success at it, as it is; the best measured is kept."""
    checks: int = 100
    """Episodes of such a measurement."""
    mastered: float = 0.99
    """Success in one at which there are no more updates."""
    effort: float = 0.001
    """What a step costs per squared action, in the task's unit of progress."""
    fall: float = 3.0
    """What an episode costs that becomes hopeless, in the task's unit of progress."""
    init_log_std: float = -1.0
    """Log standard deviation of every action at first."""
    seed: int = 0
    """Of everything random."""
    first: NpgConfig = field(default_factory=lambda: NpgConfig(
        gamma=0.99, gae_lambda=0.95, step_size=0.1, batch_size=32, min_log_std=-1.8, value_epochs=3, value_minibatch=128))
    """The learner of the easier task; it looks no further ahead than some seconds, as progress is rewarded at once."""
    then: NpgConfig = field(default_factory=lambda: NpgConfig(
        gamma=0.99, gae_lambda=0.95, step_size=0.05, batch_size=64, min_log_std=-2.3, value_epochs=3, value_minibatch=128))
    """The learner of the task."""

    def __post_init__(self) -> None:
        for name, least in (("practice", 0), ("updates", 0), ("check_every", 1), ("checks", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise ToolkitError(f"PracticeConfig.{name} is {getattr(self, name)}; give {least} or more")


def practise(
    engine: Engine,
    task: PractisedTask,
    config: PracticeConfig,
    report: Callable[[dict[str, Any]], None] = lambda record: None,
    run: Run | None = None,
) -> tuple[GaussianPolicy, ValueFunction, dict[str, Any]]:
    """Learn a task from nothing, on the unmodified robot.

    Args:
        engine: plays the task on the unmodified source.
        task: what it shall do.
        config: how.
        report: called with every event.
        run: keeps events and, after every update, everything that is needed to go on; a run that has a checkpoint is continued.

    Returns:
        policy, value function, and statistics.
    """
    learning = _Learning(engine, task, config, report, run)
    learning.restore()
    while learning.updates < config.practice + config.updates and learning.success < config.mastered:
        learning.update()
    learning.close()
    card = {"policy_steps": learning.steps, "practice": config.practice, "updates": learning.updates - config.practice}
    return *learning.best, card


class _Learning:
    """The state of the learning; every change of it ends in a checkpoint.

    Attributes:
        policy, value: that learn.  best: those with the highest measured success.
        success: that success; -1 before any was measured.
        updates: that were done, on both tasks.  steps: of the policy that were played.
    """

    def __init__(
        self, engine: Engine, task: PractisedTask, config: PracticeConfig, report: Callable[[dict[str, Any]], None], run: Run | None,
    ) -> None:
        self.config, self._report_to, self.run = config, report, run
        self.stages = [*((stage, engine.at(stage)) for stage in (task.practice(), task.scattered())), (task, engine)]
        self.rng = np.random.default_rng((config.seed, 7))
        observation, action = task.observation, task.action
        self.policy = GaussianPolicy(observation.names, action.names, self.rng, init_log_std=config.init_log_std)
        self.value = ValueFunction(observation.names, self.rng)
        self.scale = observation.numbers("scale")
        self.best, self.success = (self.policy, self.value), -1.0
        self.updates = self.steps = self._records = 0

    def close(self) -> None:
        """Stop the workers of the engines that were made here."""
        for _, engine in self.stages[:-1]:
            engine.close()

    def play(self, stage: int, first: int, count: int) -> list[Episode]:
        """Episodes of the easier task (0) or the task (1), of seeds from ``first`` on, rewarded by progress."""
        task, engine = self.stages[stage]
        played = engine.play(self.policy.act, [np.zeros(1)] * count, range(first, first + count))
        self.steps += sum(episode.steps for episode in played)
        return [self.rewarded(task, episode) for episode in played]

    def rewarded(self, task: PractisedTask, episode: Episode) -> Episode:
        """The episode, rewarded by progress."""
        if episode.diverged:
            return episode
        seen = np.vstack([episode.observations, episode.last_observation])
        rewards = task.gains(seen) - self.config.effort * np.square(np.clip(episode.actions, -1.0, 1.0)).sum(axis=1)
        rewards[-1] -= self.config.fall * (episode.terminated and not episode.success)
        return replace(episode, rewards=rewards)

    def update(self) -> None:
        """One update; before the first, how far each number of the observation scatters is measured."""
        config, done = self.config, self.updates - self.config.practice
        if self.updates == 0:
            seen = np.concatenate([e.observations for e in self.play(0, VISIT_SEEDS, config.first.batch_size) if not e.diverged])
            for network in (self.policy, self.value):
                network.set_normalisation(seen.mean(axis=0), np.maximum(seen.std(axis=0), self.scale))
        if done < 0:
            batch, npg = self.play(0, EXPERT_SEEDS + self.updates * config.first.batch_size, config.first.batch_size), config.first
        else:
            after = EXPERT_SEEDS + config.practice * config.first.batch_size
            batch, npg = self.play(1, after + done * config.then.batch_size, config.then.batch_size), config.then
        statistics = npg_step(self.policy, self.value, batch, npg, self.rng)
        reward = sum(episode.total_reward for episode in batch) / sum(episode.steps for episode in batch)
        self.updates += 1
        if done >= 0 and (done + 1) % config.check_every == 0:
            statistics["checked"] = self.check()
        self._report({"event": "practice" if done < 0 else "progress", "update": self.updates, "of": config.practice + config.updates,
                      "reward_per_step": reward, **statistics})
        self.checkpoint()

    def check(self) -> float:
        """Success of the mean action at the task as it is; keeps the best."""
        engine, count = self.stages[2][1], self.config.checks
        seeds = range(CHECKING_SEEDS, CHECKING_SEEDS + count)
        played = engine.play(MeanActor(self.policy), [np.zeros(1)] * count, seeds)
        self.steps += sum(episode.steps for episode in played)
        success = float(np.mean([episode.success for episode in played]))
        if success >= self.success:
            self.best, self.success = (self.policy.copy(), self.value.copy()), success
        return success

    def _report(self, record: dict[str, Any]) -> None:
        if self.run is not None:
            self.run.append_metrics(record)
            self._records += 1
        self._report_to(record)

    def checkpoint(self) -> None:
        """Everything that is needed to go on, in one atomic file."""
        if self.run is not None:
            state = {"updates": self.updates, "steps": self.steps, "success": self.success, "rng": generator_state(self.rng),
                     "records": self._records}
            tensors = learner_tensors("expert", self.policy, self.value) | learner_tensors("best", *self.best)
            self.run.save_checkpoint("expert", tensors, state)

    def restore(self) -> None:
        """Go on from the run's checkpoint, if it has one."""
        if self.run is None:
            return
        if "expert" in self.run.checkpoints():
            try:
                self._take_up(*self.run.load_checkpoint("expert"))
            except (LookupError, TypeError, ValueError, AttributeError) as error:
                raise ToolkitError(f"the checkpoint in {self.run.path} is damaged, or of another version ({error!r}); start a new run "
                                   "under another --run") from None
        self.run.truncate_metrics(self._records)

    def _take_up(self, tensors: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        load_learner(tensors, "expert", self.policy, self.value)
        self.updates, self.steps, self.success, self._records = state["updates"], state["steps"], state["success"], state["records"]
        if self.success >= 0.0:
            self.best = self.policy.copy(), self.value.copy()
            load_learner(tensors, "best", *self.best)
        self.rng.bit_generator.state = generator_from_state(state["rng"]).bit_generator.state
