"""Episodes played, counted, shown and told: what the schedule and the learners of a transfer have in common.

Paths may be played side by side: each counts in its own ledger, and they are shown and told one after the other.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from threading import Lock
from typing import Protocol

import numpy as np

from tasks.sight import Sight
from toolkit.learning.episode import Episode
from toolkit.learning.policy import GaussianPolicy, MeanActor
from toolkit.runs.run import Run
from toolkit.runs.seeds import CHECKING_SEEDS
from toolkit.transfer.branch import Branch
from toolkit.transfer.events import Checked, CheckedWithNoise, Entry, Event, Looked

LOOK = 8
"""Episodes of the first part of a measurement, after which a look may end it; and of the first part of a search's first batch."""
DOUBT = 3 / 4
"""Share of the wanted success rate below which a look ends after its first part."""


class Player(Protocol):
    """Plays a batch of episodes: RolloutEngine on F(alpha), NativeEngine on a robosuite robot."""

    def stop(self) -> None: ...

    def play(self, actor: Callable | Sequence[Callable], alphas: list[np.ndarray], seeds: list[int]) -> list[Episode]: ...


class Players:
    """Who plays: the engine on F(alpha), and the unmodified robots.

    Args:
        engine: plays on F(alpha).
        native: target name -> makes the player of the unmodified robot, when a path gets there.
    """

    def __init__(self, engine: Player, native: Mapping[str, Callable[[], Player]]) -> None:
        self.engine, self._makers = engine, native
        self._made: dict[str, Player] = {}

    def hops(self, branch: Branch) -> bool:
        """Whether there is an unmodified robot to which the branch hops at its end."""
        return branch.alone and branch.targets[0] in self._makers

    def native(self, branch: Branch) -> Player:
        """Plays on the unmodified robot of the branch's only target."""
        name = branch.targets[0]
        if name not in self._made:
            self._made[name] = self._makers[name]()
        return self._made[name]

    def stop(self) -> None:
        """Play no episode any more that has not begun."""
        for player in (self.engine, *self._made.values()):
            player.stop()


class Sampler:
    """Plays a transfer's episodes.

    Args:
        run: folder for the metrics.
        report: called with every entry of the metrics, for progress and pictures.
        on_batch: called with every batch that is played, before anything is learned from it: branch, episodes, whether the policy
            explored by noise on its actions, and the policy of each episode.
        sight: alpha (D,) -> how policies that are taken along see that robot; see `play`.

    Attributes:
        earlier_seconds: wall time of the sittings before this one [s].
    """

    def __init__(
        self,
        run: Run,
        report: Callable[[Entry, Branch], None],
        on_batch: Callable[[Branch, list[Episode], bool, list[GaussianPolicy]], None],
        sight: Callable[[np.ndarray], Sight],
    ) -> None:
        self.run, self.report, self.on_batch, self._sight = run, report, on_batch, sight
        self._telling = Lock()
        self._started = time.perf_counter()
        self.earlier_seconds = 0.0

    # ---- playing -----------------------------------------------------------------------------------------------

    def play(
        self, branch: Branch, player: Player, policies: list[GaussianPolicy], alphas: list[np.ndarray], seeds: list[int], noise: bool,
    ) -> list[Episode]:
        """One episode of each policy, by its mean action or under its ``noise``, timed, and diverged ones counted.

        A policy that is taken along sees every robot's object from where that robot holds it, and its fingers where the source's would
        be. On the robot it plays, and ``on_batch`` is told of it, as the policy of that robot's own observations; the episodes that are
        returned hold what the policy given here sees.
        """
        robots = {alpha.tobytes(): alpha for alpha in alphas}
        seen = {key: self._sight(alpha) for key, alpha in robots.items()}
        sights = [seen[alpha.tobytes()] for alpha in alphas]
        own = self._own(policies, sights)
        actors = [policy.act if noise else MeanActor(policy) for policy in own]
        began = time.perf_counter()
        batch = player.play(actors[0] if all(policy is own[0] for policy in own) else actors, alphas, seeds)
        branch.ledger.play_s += time.perf_counter() - began
        branch.ledger.cost.diverged += sum(episode.diverged for episode in batch)
        with self._telling:
            self.on_batch(branch, batch, noise, own)
        return [_seen(episode, sight) for episode, sight in zip(batch, sights, strict=True)]

    def own(self, policy: GaussianPolicy, alpha: np.ndarray) -> GaussianPolicy:
        """A policy that is taken along, as one of the robot ``alpha``'s (D,) own observations."""
        return self._own([policy], [self._sight(alpha)])[0]

    @staticmethod
    def _own(policies: Sequence[GaussianPolicy], sights: Sequence[Sight]) -> list[GaussianPolicy]:
        """The same, one by one; what is the same policy on the same robot is one object."""
        made: dict[tuple[int, int], GaussianPolicy] = {}
        keys = [(id(policy), id(sight)) for policy, sight in zip(policies, sights, strict=True)]
        for key, policy, sight in zip(keys, policies, sights, strict=True):
            if key not in made:
                made[key] = policy if sight.is_plain else policy.through(sight)
        return [made[key] for key in keys]

    def train(
        self, branch: Branch, player: Player, alphas: list[np.ndarray], seeds: list[int], policies: list[GaussianPolicy] | None = None
    ) -> list[Episode]:
        """Training episodes, counted: of the branch's policy under its noise, or of ``policies``, one each, without."""
        batch = self.play(branch, player, policies or [branch.policy] * len(seeds), alphas, seeds, noise=policies is None)
        branch.ledger.cost.sim_epochs += len(batch)
        return batch

    # ---- measuring ---------------------------------------------------------------------------------------------

    def success(
        self, branch: Branch, player: Player, alpha: np.ndarray, wanted: float, episodes: int, exploring: bool = False,
        hasty: bool = False, look: bool = False, floor: float | None = None, choice: int = 0,
    ) -> float:
        """Success rate of the policy on the robot ``alpha`` (D,), stopped once it is sure to be at least ``wanted``, or below ``floor``.

        Judged by the mean action, or ``exploring``, as NPG trains. A ``hasty`` one also ends after its first episodes where these
        promise little; so does a ``look`` at a robot that nothing trains for: most of those fail, and what is missed is looked at again.
        ``floor`` is ``wanted`` itself if not given; a lower one tells policies apart that are not there yet. Each ``choice`` of starts, a
        negative one included, is the same for every robot and shares none with another.

        Returns:
            the share of successes among the episodes played; at least ``wanted`` exactly if the policy has it.
        """
        needed = math.ceil(wanted * episodes)
        least = needed if floor is None else min(needed, math.ceil(floor * episodes))
        successes = played = 0
        while played < episodes and successes < needed and successes + episodes - played >= least:
            size = min(LOOK, episodes - played)
            seeds = [CHECKING_SEEDS + choice * episodes + played + i for i in range(size)]
            batch = self.play(branch, player, [branch.policy] * size, [alpha] * size, seeds, exploring)
            played += size
            successes += sum(episode.success for episode in batch)
            if (hasty or look) and successes < DOUBT * wanted * played:
                break
        branch.ledger.cost.check_episodes += played
        event = CheckedWithNoise if exploring else Looked if look else Checked
        reach = float(np.linalg.norm(alpha - branch.alpha))
        self.say(event(success=successes / played, checked=played, reach=reach, held=successes >= needed, noise=branch.noise), branch)
        return successes / played

    def watch(self, branch: Branch, player: Player, alpha: np.ndarray) -> list[Episode]:
        """A few episodes of the policy on the robot ``alpha`` (D,) that are counted as checks: to see which states it meets."""
        seeds = [CHECKING_SEEDS + i for i in range(LOOK)]
        batch = self.play(branch, player, [branch.policy] * LOOK, [alpha] * LOOK, seeds, noise=False)
        branch.ledger.cost.check_episodes += len(batch)
        return batch

    # ---- telling -----------------------------------------------------------------------------------------------

    def say(self, event: Event, branch: Branch) -> None:
        """One line of metrics.jsonl, passed on to whoever watches."""
        with self._telling:
            entry = Entry(event, branch.path, branch.stage, replace(branch.ledger.cost), self.seconds)
            branch.ledger.records += 1
            self.run.append_metrics(entry.to_json())
            self.report(entry, branch)

    @property
    def seconds(self) -> float:
        """Wall time of the run, over all its sittings [s]."""
        return self.earlier_seconds + time.perf_counter() - self._started


def _seen(episode: Episode, sight: Sight) -> Episode:
    """The episode as a policy saw it that sees the robot so."""
    if sight.is_plain:
        return episode
    return replace(episode, observations=sight(episode.observations), last_observation=sight(episode.last_observation))
