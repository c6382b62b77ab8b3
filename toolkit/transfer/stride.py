"""The next robot on a way: how far to it, and in which direction (Algorithm 1, line 4)."""

import numpy as np

from toolkit.transfer.branch import Branch
from toolkit.transfer.events import Steered
from toolkit.transfer.learners import WeightLearner
from toolkit.transfer.look_ahead import LookAhead
from toolkit.transfer.sampling import Player, Sampler
from toolkit.transfer.settings import TransferConfig
from toolkit.transfer.steering import heading, jacobian, sample_robots
from toolkit.transfer.way import Way


class Stride:
    """Chooses the robots that are trained for.

    Args:
        config: see TransferConfig.
        sampler: plays and counts.
        engine: plays on F(alpha).
        way: where paths lead.
        look_ahead: says of which robots the exploring policy is asked, too.
        weights: learns where a robot that was just measured gives signal.
    """

    def __init__(
        self, config: TransferConfig, sampler: Sampler, engine: Player, way: Way, look_ahead: LookAhead, weights: WeightLearner
    ) -> None:
        self.config, self.sampler, self.engine, self.way = config, sampler, engine, way
        self._look_ahead, self._weights = look_ahead, weights
        self._searching = config.learner == "search"

    def choose(self, branch: Branch, meta: np.ndarray) -> None:
        """Pick the next robot on the way to ``meta`` (D,).

        Fixed steps go xi far. The search trains for the farthest hope, without one for the robot twice the last stride ahead, and halves
        that where it finds no success.
        Adaptive steps of plain NPG try twice the last stride and halve it until the policy holds, and what holds is taken at once; or until
        it succeeds often enough under noise to learn there, or xi is reached, and training begins. Where only noise stands in the way,
        there is less of it. The way has one direction per choice; an optimised one is estimated only once the meta robot itself is out of
        reach.
        """
        if branch.hopes:
            branch.begin_phase(branch.hopes.pop(0))
            return
        distance = float(np.linalg.norm(meta - branch.alpha))
        shortest = min(self.config.xi, distance)
        stride = shortest if self.config.step == "fixed" else min(max(2 * branch.stride, shortest), distance)
        direction: np.ndarray | None = None
        while True:
            # A remainder shorter than xi would cost a phase of its own.
            last = stride >= distance - (self.config.xi if self.config.step == "adaptive" and stride > shortest else 1e-12)
            if not last and direction is None:
                direction = self._steer(branch, meta)
            candidate = meta if last or direction is None else np.clip(branch.alpha + stride * direction, 0.0, 1.0)
            branch.begin_phase(candidate)
            if self.config.step == "fixed" or stride <= shortest or self._searching or self._settled(branch, candidate, stride):
                return
            stride = max(stride / 2, shortest)

    def _settled(self, branch: Branch, candidate: np.ndarray, stride: float) -> bool:
        """Move to the candidate (D,) if plain NPG's policy holds there, or begin to train if it gives signal; False: it is too far."""
        wanted, enough, episodes = self.config.threshold, self.config.noisy_threshold, self.config.check_episodes
        mean = self.sampler.success(branch, self.engine, candidate, wanted, episodes)
        if mean >= wanted and not self._look_ahead.asks_noise(branch, candidate):
            self.way.move(branch, candidate, stride, trained=False)
            return True
        noisy = self.sampler.success(branch, self.engine, candidate, enough, episodes, exploring=True)
        while mean >= wanted and self.config.signal <= noisy < enough and self._weights.calm(branch):
            noisy = self.sampler.success(branch, self.engine, candidate, enough, episodes, exploring=True)
        if mean >= wanted and noisy >= enough:
            self.way.move(branch, candidate, stride, trained=False)
            return True
        if noisy >= self.config.signal:
            self._weights.improve(branch, self.engine, candidate)  # it was measured just now
            return True
        return False

    def try_nearer(self, branch: Branch, meta: np.ndarray) -> None:
        """After a phase without success train for the next hope, else for a robot half as far, and at the nearest look ahead anew.

        On an optimised path to ``meta`` (D,) the robot half as far is where the return rises.
        """
        assert branch.next_alpha is not None
        if branch.hopes:
            branch.begin_phase(branch.hopes.pop(0))
        elif branch.can_halve(self.config.xi):
            half = 0.5 * (branch.next_alpha - branch.alpha)
            if self.config.path == "optimised":
                half = float(np.linalg.norm(half)) * self._steer(branch, meta)
            branch.begin_phase(np.clip(branch.alpha + half, 0.0, 1.0))
        else:
            branch.looked = False  # the policy has changed since
            branch.begin_phase()

    def _steer(self, branch: Branch, meta: np.ndarray) -> np.ndarray:
        """Unit vector (D,) of the way on: straight to ``meta``, or bent to where the policy earns more.

        The episodes that this takes train nothing but cost the same, and are counted as simulation epochs.
        """
        straight = (meta - branch.alpha) / np.linalg.norm(meta - branch.alpha)
        if self.config.path != "optimised":
            return straight
        robots = sample_robots(branch.alpha, self.config.jacobian_episodes, self.config.xi, branch.rng)
        seeds = np.repeat(branch.training_seeds(-(-len(robots) // 2)), 2)[: len(robots)].tolist()
        policies = [branch.policy] * len(robots) if self._searching else None
        batch = self.sampler.train(branch, self.engine, list(robots), seeds, policies)
        returns = np.array([episode.discounted_return(self.config.npg.gamma) for episode in batch])
        slope = jacobian(robots, returns)
        direction = heading(slope, branch.alpha, meta, self.config.pull)
        event = Steered(mean_return=float(returns.mean()), slope=float(np.linalg.norm(slope)), straight_share=float(direction @ straight))
        self.sampler.say(event, branch)
        return direction
