"""The two ways in which a branch's policy gets better: its weights by NPG, a few of its parameters by a search.

    WeightLearner   the paper's: noise on the actions, robots from a window, natural policy gradient on all weights
    SearchLearner   a few offsets or gains of what it sees, or responses to what it meets, held for an episode, on the next robot itself
"""

import math
from dataclasses import replace
from threading import Lock

import numpy as np

from toolkit.errors import ToolkitError
from toolkit.evolution import Terminal
from toolkit.learning.episode import Episode
from toolkit.learning.exploration import Directions, Explored, Gains, Trials, leading_features, mirrored, natural_step
from toolkit.learning.npg import Demonstrations, npg_step
from toolkit.learning.policy import GaussianPolicy, MeanActor
from toolkit.runs.seeds import SHOWING_SEEDS
from toolkit.transfer.branch import TURNS, Branch
from toolkit.transfer.events import SearchUpdated, WeightsUpdated
from toolkit.transfer.sampling import LOOK, Player, Sampler
from toolkit.transfer.settings import TransferConfig


class WeightLearner:
    """Natural policy gradient on the weights.

    Args:
        config: see TransferConfig.
        sampler: plays and counts.
        engine: plays the expert's demonstrations.
        source: where the expert shows what it does.
        expert: the source's policy, a copy of its own.
    """

    def __init__(self, config: TransferConfig, sampler: Sampler, engine: Player, source: Terminal, expert: GaussianPolicy) -> None:
        self.config, self.sampler, self._engine, self._source, self._expert = config, sampler, engine, source, expert
        self._shown: Demonstrations | None = None
        self._showing = Lock()

    def improve(self, branch: Branch, player: Player, alpha: np.ndarray) -> float:
        """One update, on robots drawn from the part of the segment from branch.alpha to ``alpha`` (D,) that the window leaves open.

        Returns:
            the share of its episodes that succeeded.
        """
        cost, sampler = branch.ledger.cost, self.sampler
        size = self.config.npg.batch_size
        shares = 1.0 - branch.window * branch.rng.uniform(size=size)
        alphas = [branch.alpha + share * (alpha - branch.alpha) for share in shares]
        before = branch.ledger.play_s
        batch = sampler.train(branch, player, alphas, branch.training_seeds(size))
        play_seconds = branch.ledger.play_s - before
        shown = self.demonstrations(cost.train_iterations) if self.config.kind == "direct" else None
        statistics = npg_step(branch.policy, branch.value, batch, self.config.npg, branch.rng, shown)
        branch.ledger.learn_s += statistics["seconds"]
        cost.train_iterations += 1
        branch.window *= self.config.shrink
        branch.updates += 1
        success = float(np.mean([episode.success for episode in batch]))
        returns = [episode.discounted_return(self.config.npg.gamma) for episode in batch]
        event = WeightsUpdated(
            learner="npg", train_success=success, mean_return=float(np.mean(returns)), episodes_per_s=size / play_seconds,
            play_s=play_seconds, window=branch.window, kl=statistics["kl"], learn_s=statistics["seconds"],
        )
        sampler.say(event, branch)
        return success

    def calm(self, branch: Branch, factor: float | None = None) -> bool:
        """Less exploration, if there is any to spare: where the mean action holds, more noise than it bears teaches it to bear noise.

        With ``rouse`` a success rule, as evolution strategies have for the length of their steps (Rechenberg 1973). ``factor``: of the
        configuration if not given.
        """
        return self._explore(branch, max((factor or self.config.calm) * branch.noise, self.config.least_noise))

    def rouse(self, branch: Branch) -> bool:
        """More exploration, never beyond the first: where the mean action fails there is to learn, and steps are as long as the noise."""
        return self._explore(branch, min(branch.noise / self.config.calm, 1.0))

    def _explore(self, branch: Branch, noise: float) -> bool:
        """Give the exploration the share ``noise`` of its standard deviation; returns whether it had another one."""
        if self.config.step == "fixed" or noise == branch.noise:
            return False
        branch.policy.set_log_std(branch.policy.log_std + math.log(noise / branch.noise))
        branch.noise = noise
        return True

    def demonstrations(self, update: int) -> Demonstrations | None:
        """What the expert did on the source where it succeeded; a resumed run plays the same again."""
        with self._showing:
            if self._shown is None and self.config.demonstrations:
                self._shown = self._show()
        return None if self._shown is None else replace(self._shown, update=update)

    def _show(self) -> Demonstrations:
        seeds = [SHOWING_SEEDS + i for i in range(self.config.demonstrations)]
        played = self._engine.play(MeanActor(self._expert), [self._source.alpha] * len(seeds), seeds)
        good = [episode for episode in played if episode.success]
        if not good:
            raise ToolkitError(f"the expert fails {len(seeds)} times of {len(seeds)} on {self._source.name}; train it again")
        observations = np.concatenate([episode.observations for episode in good])
        return Demonstrations(observations, np.concatenate([episode.actions for episode in good]))


class SearchLearner:
    """Search of an offset of what the policy sees and, in turns of their own, of gains and of how it responds to what it meets.

    Args:
        config: see TransferConfig.
        sampler: plays and counts.
        explored: what is explored, and how far.

    Attributes:
        turns: in a phase, in this order: those that have something to explore, and the weights'.
    """

    def __init__(self, config: TransferConfig, sampler: Sampler, explored: Explored) -> None:
        self.config, self.sampler, self.explored = config, sampler, explored
        asked = {"offset": True, "gain": bool(explored.gains), "response": bool((explored.action > 0).any()), "weights": True}
        self.turns = tuple(turn for turn in TURNS if asked[turn])

    def directions(self, branch: Branch) -> Directions | Gains:
        """Those of the branch's turn."""
        if branch.turn == "gain":
            return Gains(self.explored.gains)
        none = np.zeros((0, branch.policy.hidden[-1] + 1))
        return Directions(self.explored, none if branch.features is None else branch.features)

    def improve(self, branch: Branch, player: Player, alpha: np.ndarray, success: float, holds: bool = False) -> bool:
        """One update on the robot ``alpha`` (D,), where the policy's mean action was measured to have that ``success``.

        A turn begins with the deviations that the last one came to; with those for polishing at most where the policy ``holds`` already;
        and with the declared ones where it has no success, and for gains on the last hop: what is seen late there asks for another pace,
        which is no polish.

        Mirrored steps of a pair play the same start, so that a pair's difference is the step's. The first batch of a phase ends after
        its first episodes if none succeeds, unless the policy itself does.

        Returns:
            whether it learned; without a success the policy is left alone.
        """
        settings, sampler, cost = self.config.search, self.sampler, branch.ledger.cost
        before = branch.ledger.play_s
        if branch.turn == "response" and branch.features is None:
            met = np.concatenate([episode.observations for episode in sampler.watch(branch, player, alpha)])
            count = settings.features_of(int(np.count_nonzero(self.explored.action)))
            branch.features = leading_features(branch.policy, met, count)
        directions = self.directions(branch)
        declared = directions.deviation
        if branch.deviation is None or branch.centre is None:
            paced = branch.turn == "gain" and branch.stage == "settle"
            begins = 1.0 if success == 0 or paced else min(branch.width, settings.polish if holds else 1.0)
            branch.deviation = declared * begins
            branch.centre = np.zeros_like(declared)
        deviation, centre = branch.deviation, branch.centre
        steps = mirrored(settings.batch_size // 2, len(declared), branch.rng) * deviation
        seeds = np.repeat(branch.training_seeds(len(steps) // 2), 2).tolist()
        policies = [directions.moved(branch.policy, step) for step in steps]
        batch: list[Episode] = []
        for part in (slice(0, LOOK), slice(LOOK, None)) if branch.updates == 0 else (slice(None),):
            if seeds[part] and (not batch or success > 0 or any(episode.success for episode in batch)):
                batch += sampler.train(branch, player, [alpha] * len(seeds[part]), seeds[part], policies[part])
        ended = np.array([episode.success for episode in batch], float)
        seen = branch.trials or Trials.none(len(declared))
        branch.trials = seen.add(centre + steps[: len(batch)], centre, deviation, ended, settings.reuse)
        learned = success > 0 or bool(branch.trials.success.any())
        if learned:
            mean, spread = natural_step(branch.trials, centre, deviation, settings.prior, success, settings.batch_size)
            step = deviation * mean
            branch.policy, branch.centre = directions.moved(branch.policy, step), centre + step
            branch.deviation = np.clip(
                deviation * np.exp(settings.deviation_rate * spread), settings.narrowest * declared, settings.widest * declared
            )
            cost.train_iterations += 1
        branch.updates += 1
        width = float((branch.deviation / declared).mean())
        branch.width = min(width, 1.0)
        if ended.mean() > branch.best_drawn:
            branch.best_drawn, branch.idle = float(ended.mean()), 0
        play_seconds = branch.ledger.play_s - before
        returns = [episode.discounted_return(self.config.npg.gamma) for episode in batch]
        event = SearchUpdated(
            learner="search", train_success=float(ended.mean()), mean_return=float(np.mean(returns)),
            episodes_per_s=len(batch) / play_seconds, play_s=play_seconds, turn=branch.turn, learned=learned, width=width,
        )
        sampler.say(event, branch)
        return learned
