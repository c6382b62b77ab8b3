"""The robots between two robots: whether what they can do lies between what the two can, and what is to blame where it does not.

The promise, per edge, from what its two ends can do:

    grip             at least 0.8 of the weaker end and at most 1.25 of the stronger
    balance          never one-sided beyond the worse end
    height           of the grip within the ends' interval, widened by 5 mm
    opening, closing within the ends' interval, widened by a tenth
    script           holds wherever it holds at both ends
    tolerance        at least 0.8 of the weaker end: how many of a few grasps hold that are off by as much as a policy may be

It is kept in reserve where an end cannot hold the object at all: there is nothing to promise.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import pairwise, repeat
from queue import SimpleQueue
from typing import Any

import numpy as np

from toolkit.capability.bench import NOTHING, Bench, Capability
from toolkit.capability.ways import Way, gone_at
from toolkit.errors import ToolkitError
from toolkit.morphology.build import MergedRobot

WEAKER, STRONGER = 0.8, 1.25
"""Shares of the weaker and of the stronger end between which the grip lies."""
ASKEW = 0.1
"""Balance that a robot may lack of the worse end's: what the measurement itself wavers by."""
HEIGHT_MM = 5.0
WIDENED = 0.1
"""Share of the ends' interval, and of its larger end, by which opening and closing time may leave it."""
ONE_STEP, ONE_MM = 1.0, 1.0
"""Closing is counted in whole policy steps, and an opening means as little below a millimetre."""
HOLDS = 15 / 16
"""Success rate from which a script holds."""
REFINED = 4
"""Robots that are looked at beside the evenly spaced ones, each between the worst so far and its neighbours."""
SHARES, LEAST_SHARE = ("balance", "script", "tolerance"), 0.1
"""Quantities without a unit, and the least limit [1] against which these are weighed; the others' is one of their unit."""
SOUGHT = 160
"""Turns that are tried for an edge that no digits' going first mends, if not told otherwise."""
ROUND = 4
"""Of these, at a time: only the best of them where the promise is broken worst is measured along the whole way."""
MOVED, FEWEST = 0.15, 3
"""Share of the groups of parameters that differ between one turn and the next, and how many do at least, on average."""
SPREAD = 0.35
"""Standard deviation by which they do, in shares of the way."""
PROBES = 9
"""Robots, evenly spaced between the ends, at which every group of parameters is asked what it does alone."""
ASIDE, FINEST = 0.4, 0.1
"""Shares of the way by which a group goes earlier or later for that: at first, and at least; halved where nothing helps."""
ALIKE = 1 / 3
"""Share of a limit by which leaving it counts as much as HEIGHT_MM of height."""
LOST = 3.0
"""What leaving a limit counts at most."""
TRIED = ("script", "tolerance")
"""Quantities that are measured on some robots alone, by playing."""
QUANTITIES = {
    "grip_n": "grip force", "balance": "balance", "height_mm": "height of the grip", "opening_mm": "opening",
    "closing_steps": "closing time", "script": "the script", "tolerance": "tolerance of grasps",
}
"""Quantity of a capability -> what it is called."""


@dataclass(frozen=True)
class Violation:
    """A robot that breaks the promise.

    Attributes:
        share: of the way.
        quantity: key of QUANTITIES.
        value: what it has.  allowed: (low, high) what the ends allow.
        cause: which element, and which of its quantities, take it there; None: not asked.
    """

    share: float
    quantity: str
    value: float
    allowed: tuple[float, float]
    cause: str | None = None

    @property
    def beyond(self) -> float:
        """How far the value lies outside, in its unit; what has no value is as far out as can be."""
        low, high = self.allowed
        return max(low - self.value, self.value - high) if np.isfinite(self.value) else float("inf")

    @property
    def excess(self) -> float:
        """The same as a share of the nearer limit."""
        low, high = self.allowed
        limit, least = abs(low if self.value < low else high), LEAST_SHARE if self.quantity in SHARES else 1.0
        return self.beyond / max(limit, least) if np.isfinite(self.value) else float("inf")

    def to_json(self) -> dict[str, Any]:
        """As plain numbers; an open limit is null."""
        plain = lambda x: round(float(x), 4) if np.isfinite(x) else None  # noqa: E731
        return {"share": round(self.share, 4), "quantity": self.quantity, "value": plain(self.value),
                "allowed": [plain(x) for x in self.allowed], "cause": self.cause}

    def sentence(self) -> str:
        """In words, for a table and for a run's report."""
        low, high = self.allowed
        asked = f"at least {low:.3g}" if self.value < low else f"at most {high:.3g}"
        because = "" if self.cause is None else f"; caused by {self.cause}"
        return f"{QUANTITIES[self.quantity]} {self.value:.3g} at {self.share:.1%} of the way, {asked} asked{because}"


def outside(found: Sequence[Violation]) -> float:
    """How far outside of what is allowed it all is, in sum; unlike ``broken``, every bit less of it counts."""
    return sum(min(v.beyond / HEIGHT_MM if v.quantity == "height_mm" else v.excess / ALIKE, LOST) for v in found)


def broken(found: Sequence[Violation]) -> float:
    """How much of the promise is broken: the worst excess of every quantity, 1 at most; a script that fails, and grasps that are not
    tolerated, before all else."""
    worst: dict[str, float] = {}
    for violation in found:
        worst[violation.quantity] = max(worst.get(violation.quantity, 0.0), min(violation.excess, 1.0))
    return sum(worst.values()) + len(QUANTITIES) * (("script" in worst) + worst.get("tolerance", 0.0))


@dataclass(frozen=True)
class Edge:
    """An audited way: what its robots can do, by share of the way, and where that breaks the promise (worst first).

    ``reserve``: why the promise is not meant on it.  ``whole``: all was measured, not only what turns are compared by.
    """

    way: Way
    robots: dict[float, Capability]
    violations: list[Violation] = field(default_factory=list)
    reserve: str | None = None
    whole: bool = True

    def to_json(self) -> dict[str, Any]:
        """As plain numbers."""
        return {
            "from": self.way.start, "to": self.way.end, "turn": self.way.turn and dict(self.way.turn), "reserve": self.reserve,
            "robots": [{"share": round(share, 4), **robot.to_json()} for share, robot in sorted(self.robots.items())],
            "violations": [violation.to_json() for violation in self.violations],
        }

    @property
    def broken(self) -> float:
        """How much of the promise is broken; see ``broken``."""
        return broken(self.violations)

    @property
    def rank(self) -> tuple[float, float]:
        """What is compared where a way may turn in several ways: how much is broken, then for how long; less is better."""
        return self.broken, self.stretch

    @property
    def stretch(self) -> float:
        """Share of the way on which it is broken."""
        bad = {violation.share for violation in self.violations}
        return sum((after - before) * ((before in bad) + (after in bad)) / 2.0 for before, after in pairwise(sorted(self.robots)))

    @property
    def ends(self) -> tuple[Capability, Capability]:
        """What the two ends can do."""
        return self.robots[0.0], self.robots[1.0]


def _ends(edge: Edge) -> dict[float, Capability]:
    """What the two ends can do, by share of the way."""
    return {0.0: edge.ends[0], 1.0: edge.ends[1]}


def allowed(quantity: str, first: Capability, last: Capability) -> tuple[float, float] | None:
    """What the ends of a way allow of a quantity in between; None: an end has no value, or its script does not hold."""
    ends = [getattr(robot, quantity) for robot in (first, last)]
    if any(end is None for end in ends):
        return None
    low, high = min(ends), max(ends)
    if quantity == "grip_n":
        return WEAKER * low, STRONGER * high
    if quantity == "balance":
        return low - ASKEW, np.inf
    if quantity == "height_mm":
        return low - HEIGHT_MM, high + HEIGHT_MM
    if quantity == "script":
        return (HOLDS, np.inf) if low >= HOLDS else None
    if quantity == "tolerance":
        return WEAKER * low, np.inf
    slack = WIDENED * max(high - low, high) + (ONE_STEP if quantity == "closing_steps" else ONE_MM)
    return low - slack, high + slack


def reserve(way: Way, first: Capability, last: Capability, width: float) -> str | None:
    """Why the promise is not meant on a way: an end that cannot hold an object ``width`` [m] wide; None: it is."""
    for name, robot in ((way.start, first), (way.end, last)):
        # A hand may open by less than the object's width beside the grasp frame, and reach over it all the same.
        if robot.opening_mm < 1e3 * width and robot.balance > 0.0:
            return f"{name} opens by {robot.opening_mm:.0f} mm and the object is {1e3 * width:.0f} mm wide, so there is nothing to promise"
        if robot.grip_n < NOTHING:
            return f"{name} grips the object with {robot.grip_n:.2f} N, so there is nothing to promise on the way"
    return None


def violations(robots: dict[float, Capability]) -> list[Violation]:
    """Where the robots between the ends, by share of the way, break the promise; worst first."""
    first, last = robots[0.0], robots[1.0]
    out = []
    for quantity in QUANTITIES:
        limits = allowed(quantity, first, last)
        if limits is None:
            continue
        for share, robot in robots.items():
            value = getattr(robot, quantity)
            if quantity in TRIED and value is None:
                continue
            value = np.inf if value is None else float(value)
            if quantity in ("height_mm", "balance") and robot.grip_n < NOTHING:
                continue  # where nothing acts there is no place and no balance; the grip says it
            if not limits[0] <= value <= limits[1]:
                out.append(Violation(share, quantity, value, limits))
    return sorted(out, key=lambda violation: -violation.excess)


class Audit:
    """Audits ways through one merged robot, on all cores.

    Args:
        merged: the merged robot in its task.
        robots: evenly spaced per way, its ends included.
        episodes: of the script per robot and grasp; 0: it is not tried.
        scripted: every how many of them the script is tried on.
        causes: whether to ask what causes the worst violation of every quantity.
        brief: only what a closed gripper tells; a second per way.
        tries: turns that ``best`` searches where no digits' going first keeps the promise; 0: none.
        threads: workers; default: the machine's cores.
    """

    def __init__(
        self, merged: MergedRobot, robots: int = 17, episodes: int = 4, scripted: int = 4, causes: bool = True,
        brief: bool = False, tries: int = SOUGHT, threads: int | None = None,
    ) -> None:
        if robots < 2 or episodes < 0 or scripted < 1:
            raise ToolkitError(f"an audit needs 2 robots per edge or more, and 0 episodes or more; got {robots} and {episodes}")
        if tries < 0:
            raise ToolkitError(f"an audit searches 0 turns or more; got {tries}")
        self.merged, self.count, self.episodes, self.scripted, self.causes = merged, robots, episodes, scripted, causes
        self._brief, self._tries = brief, tries
        self._pool = ThreadPoolExecutor(threads or len(os.sched_getaffinity(0)))
        self._idle: SimpleQueue[Bench] = SimpleQueue()
        for _ in range(self._pool._max_workers):
            self._idle.put(Bench(merged))

    def best(self, way: Way) -> Edge:
        """A way audited as it is, or turned, whichever keeps the promise best; of equals the one that breaks it for the shortest stretch.

        It turns so that some digits of the grasp go first, or, where no such turn keeps the promise, as a search finds it.
        """
        # Asked of what the promise is about, by one episode of a grasp; what seems to keep it has to keep it in full.
        best = self._audited(way, quick=1)
        ends = _ends(best)
        best = self._sure(best)
        for turn in way.turns(self.merged.space):
            other = way.bent(self.merged.space, turn) if best.violations else None
            if other is None:
                continue
            # What a script tells takes longest, and only ever adds to what is broken.
            edge = self._audited(other, script=False, known=ends, quick=1)
            if self.episodes and edge.broken <= best.broken:
                edge = self._audited(other, known=ends, quick=1)
            if edge.rank < best.rank:
                best = min(best, self._sure(edge), key=lambda edge: edge.rank)
        # What is told by playing takes minutes to search.
        played = self._brief and any(v.quantity in TRIED for v in best.violations)
        if best.violations and self._tries and not played:
            best = self._sought(way, best, ends)
            if best.violations and not self._brief:
                best = self._steered(way, best, ends)
        return self._explained(best if best.whole or self._brief else self._audited(best.way))

    def _sure(self, edge: Edge) -> Edge:
        """An edge on which a quick look found nothing broken, in full; any other as it is."""
        return edge if edge.violations or self._brief else self._audited(edge.way)

    def _sought(self, way: Way, best: Edge, ends: dict[float, Capability]) -> Edge:
        """A search of a turn that keeps the promise better than ``best`` does, whose ``ends`` these are; ``best`` if it finds none.

        Where each group of parameters stands at the corner is what is searched, by an evolution strategy that keeps the better of two
        (Rechenberg 1973). A turn that is no better on the robot that is worst now is given up after that one. Scripted grasps are played
        if they break the promise now, once each, and as often as in full from where that has missed something.
        """
        space, generator, quick = self.merged.space, np.random.default_rng(0), 1
        groups, shares = space.groups(), self._gone(best.way)
        for _ in range(0, self._tries, ROUND):
            script = any(v.quantity in TRIED for v in best.violations)
            ways = []
            for _ in range(ROUND):
                moved = generator.random(len(groups)) < max(MOVED, FEWEST / len(groups))
                steps = SPREAD * generator.standard_normal(len(groups))
                tried = np.clip(shares + np.where(moved, steps, 0.0), 0.0, 1.0)
                turned = self._turned(way, tried)
                if turned is not None:
                    ways.append(turned)
            worst = best.violations[0].share
            probes = self._pool.map(self._one, [turned.at(worst) for turned in ways], repeat(self.episodes * script), repeat(quick))
            there = [broken(violations(ends | {worst: probe})) for probe in probes]
            if not there or min(there) >= broken([v for v in best.violations if v.share == worst]):
                continue
            turned = ways[int(np.argmin(there))]
            edge, ends, quick = self._against(best, turned, ends, quick)
            if edge.rank < best.rank and edge.way.turn is not None:
                best, shares = edge, np.array([edge.way.turn[name] for name in groups])
            if not best.violations:
                break
        return best

    def _against(
        self, best: Edge, turned: Way, ends: dict[float, Capability], quick: int
    ) -> tuple[Edge, dict[float, Capability], int]:
        """A turn that may be better than ``best``, audited as far as that takes; and what a search goes on with as ``ends`` and ``quick``:
        those of the full audit from where a quick look has missed something."""
        script = any(v.quantity in TRIED for v in best.violations)
        edge = self._audited(turned, script, ends, quick)
        if edge.rank < best.rank and not script:
            edge = self._audited(turned, known=ends, quick=quick)
        if not edge.violations:
            edge = self._sure(edge)
            if edge.violations and quick < self.episodes:
                return edge, _ends(edge), self.episodes
        return edge, ends, quick

    def _turned(self, way: Way, shares: np.ndarray) -> Way | None:
        """A way that turns where each group of parameters has gone its share (n_groups,); None: as ``Way.bent``."""
        space = self.merged.space
        return way.bent(space, {name: round(float(share), 2) for name, share in zip(space.groups(), shares, strict=True)})

    def _gone(self, way: Way) -> np.ndarray:
        """(n_groups,) share of its way that each group of parameters has gone where a way turns."""
        gone = gone_at(way.turn or {}, self.merged.space)
        return np.array([gone[dimensions[0]] for dimensions in self.merged.space.groups().values()])

    def _steered(self, way: Way, best: Edge, ends: dict[float, Capability]) -> Edge:
        """As ``_sought``, from where that has ended, group by group (a pattern search: Hooke and Jeeves 1961): three times as many turns.

        Each group of parameters is moved alone, earlier and later, and measured at robots along the whole way and where it was worst; what
        helps is taken together, the most telling first, as long as it still helps. Then the whole way is audited, and the worst of it
        measured as well from then on. A turn is given up at the robot with which it is no better; scripted grasps are played last.
        """
        quick, left, aside = 1, 3 * self._tries, ASIDE
        shares, now = self._gone(best.way), best
        probes = dict.fromkeys(np.linspace(0.0, 1.0, PROBES + 2)[1:-1].tolist(), False)

        def moved(places: np.ndarray, group: int, place: float) -> tuple[np.ndarray, Way | None]:
            places = places.copy()
            places[group] = place
            return places, self._turned(way, places)

        def costs(tried: Way, most: float = np.inf) -> float:
            total = 0.0
            for share, played in probes.items():
                found = violations(ends | {share: self._one(tried.at(share), self.episodes if played else 0, quick)})
                total += outside(found)
                if total >= most:
                    break
            return total

        # A digit that goes first is none of these groups: the search begins with the turn by groups that is most like it.
        here = self._turned(way, shares) or way
        while left > 0 and best.violations:
            for quantity in {violation.quantity for violation in now.violations}:
                worst = next(violation for violation in now.violations if violation.quantity == quantity)
                probes[worst.share] = probes.get(worst.share, False) or quantity in TRIED
            probes = dict(sorted(probes.items(), key=lambda probe: (probe[1], probe[0])))
            least = costs(here)
            moves = []
            for group, share in enumerate(shares):
                for place in sorted({max(share - aside, 0.0), min(share + aside, 1.0)} - {share}):
                    _, tried = moved(shares, group, place)
                    if tried is not None:
                        moves.append((group, place, tried))
            found = self._pool.map(costs, [tried for _, _, tried in moves], repeat(least))
            helping = sorted((cost, *moves[k][:2]) for k, cost in enumerate(found) if cost < least)
            left -= len(moves) + len(helping)
            gone, there = shares, here
            for _, group, place in helping:
                places, tried = moved(gone, group, place)
                cost = np.inf if tried is None else costs(tried, least)
                if tried is not None and cost < least:
                    gone, there, least = places, tried, cost
            if there is here:
                aside *= 0.5
                if aside < FINEST:
                    break
                continue
            shares, here = gone, there
            now, ends, quick = self._against(best, here, ends, quick)
            if now.rank < best.rank:
                best = now
        return best

    def close(self) -> None:
        """Stop the workers."""
        self._pool.shutdown()

    def along(self, way: Way) -> Edge:
        """What the robots of a way can do, evenly spaced and where it looks worst, and what causes it."""
        return self._explained(self._audited(way))

    def _audited(
        self, way: Way, script: bool = True, known: Mapping[float, Capability] | None = None, quick: int | None = None,
    ) -> Edge:
        """A way without causes; with the script or without, and what is ``known`` of its robots by share of the way, as of its ends.

        ``quick``: only what the promise is about, and at most so many episodes of each scripted grasp.
        """
        shares = np.linspace(0.0, 1.0, self.count).tolist()
        tried = {float(s) for s in shares[:: self.scripted]} | {1.0} if script else set()
        robots = dict(known or {})
        robots |= self._measured(way, [share for share in shares if share not in robots], tried, quick)
        why = reserve(way, robots[0.0], robots[1.0], self.merged.task.object.width)
        if why is not None:
            return Edge(way, robots, [], why, whole=quick is None)
        robots |= self._refined(way, robots, quick)
        return Edge(way, dict(sorted(robots.items())), violations(robots), whole=quick is None)

    def _explained(self, edge: Edge) -> Edge:
        """With the cause of the worst violation of every quantity, where causes are asked for."""
        if not self.causes:
            return edge
        found = edge.violations
        worst = {v.quantity: v for v in reversed(found)}
        told = [replace(v, cause=self._cause_on(edge.way, v, found, edge.robots)) if worst[v.quantity] is v else v for v in found]
        return replace(edge, violations=told)

    def _measured(self, way: Way, shares: Sequence[float], scripted: set[float], quick: int | None) -> dict[float, Capability]:
        ask = lambda share: self._one(way.at(share), self.episodes if float(share) in scripted else 0, quick)  # noqa: E731
        return {float(share): robot for share, robot in zip(shares, self._pool.map(ask, shares), strict=True)}

    def _one(self, alpha: np.ndarray, episodes: int = 0, quick: int | None = None) -> Capability:
        bench = self._idle.get()
        try:
            if self._brief:
                return bench.measure(alpha, episodes, "closed")
            return bench.measure(alpha, episodes) if quick is None else bench.measure(alpha, min(episodes, quick), "promised")
        finally:
            self._idle.put(bench)

    def _alone(self, alpha: np.ndarray, quantity: str) -> float:
        """One quantity of a robot; one that has no value counts as 0."""
        bench = self._idle.get()
        try:
            return float(bench.quantity(alpha, quantity, self.episodes) or 0.0)
        finally:
            self._idle.put(bench)

    def _refined(self, way: Way, robots: dict[float, Capability], quick: int | None) -> dict[float, Capability]:
        """Robots halfway between the worst one so far and its neighbours; the grip's lowest where nothing is wrong."""
        out: dict[float, Capability] = {}
        while len(out) < REFINED:
            known = robots | out
            found = violations(known)
            if self._brief and found and found[0].quantity in TRIED:
                return out  # that it fails is known, and failing takes the longest
            inner = [share for share in known if 0.0 < share < 1.0] or [0.0]
            worst = found[0].share if found else min(inner, key=lambda share: known[share].grip_n)
            order = sorted(known)
            place = order.index(worst)
            sides = [0.5 * (order[place] + order[other]) for other in (place - 1, place + 1) if 0 <= other < len(order)]
            fresh = self._measured(way, sides, set(sides) if found and found[0].quantity in TRIED else set(), quick)
            out |= fresh
        return out

    def change(self, way: Way) -> str:
        """In words, what changes most between the ends of a short way, and what makes it: why a policy may hold on one and not on
        the other."""
        first, last = self._pool.map(self._one, (way.first, way.last))
        scale = {"grip_n": max(first.grip_n, last.grip_n, 1.0), "balance": 1.0, "height_mm": 4 * HEIGHT_MM,
                 "opening_mm": max(first.opening_mm, last.opening_mm, 1.0)}
        changes = {name: (getattr(last, name) - getattr(first, name)) / size for name, size in scale.items()}
        name = max(changes, key=lambda key: abs(changes[key]))
        length = float(np.linalg.norm(way.last - way.first))
        before, after = getattr(first, name), getattr(last, name)
        if abs(changes[name]) < WIDENED:
            return f"what the robot can do hardly changes within {length:.2g} there, so it is the policy that has to"
        limits = (before, np.inf) if after < before else (-np.inf, before)
        cause = self.cause(way.first, way.last, Violation(1.0, name, after, limits))
        rises = "falls" if after < before else "rises"
        because = "" if cause is None else f"; caused by {cause}"
        return f"{QUANTITIES[name]} {rises} from {before:.3g} to {after:.3g} within {length:.2g} there{because}"

    # ---- what is to blame ----------------------------------------------------------------------------------------

    def _cause_on(self, way: Way, violation: Violation, found: list[Violation], robots: dict[float, Capability]) -> str | None:
        """The cause, seen from the nearest robot on the way whose quantity is sound."""
        broken = {v.share for v in found if v.quantity == violation.quantity}
        nearest = min((share for share in robots if share not in broken), key=lambda share: abs(share - violation.share))
        return self.cause(way.at(nearest), way.at(violation.share), violation)

    def cause(self, start: np.ndarray, goal: np.ndarray, violation: Violation) -> str | None:
        """The element, and its quantities, that take a robot out of the promise: each moved to the goal by itself from a sound start.

        None: no single element does it.
        """
        space = self.merged.space
        moving = np.flatnonzero(np.abs(goal - start) > 1e-12)
        elements: dict[str, set[int]] = {}
        quantities: dict[int, list[str]] = {}
        for parameter in space.parameters:
            if parameter.dimension in moving:
                elements.setdefault(parameter.element, set()).add(parameter.dimension)
                quantities.setdefault(parameter.dimension, []).append(parameter.name.split(".")[1])
        first, element = self._blamed(violation, start, goal, {name: sorted(dims) for name, dims in elements.items()})
        if element is None:
            return None
        parts = {str(dimension): [dimension] for dimension in elements[element]}
        if len(parts) == 1:
            return f"{element}, whose quantities move as one here"
        second, dimension = self._blamed(violation, start, goal, parts)
        if dimension is None or second < 0.5 * first:
            return f"{element}, by several of its quantities together"
        return f"{element}: {', '.join(dict.fromkeys(quantities[int(dimension)]))}"

    def _blamed(
        self, violation: Violation, start: np.ndarray, goal: np.ndarray, groups: dict[str, list[int]]
    ) -> tuple[float, str | None]:
        """Which group of dimensions, moved to the goal by itself, takes the quantity furthest the wrong way; and how far."""
        sign = 1.0 if violation.value > violation.allowed[1] else -1.0

        def moved(dimensions: list[int]) -> float:
            alpha = start.copy()
            alpha[dimensions] = goal[dimensions]
            return self._alone(alpha, violation.quantity)

        base = self._alone(start, violation.quantity)
        names = list(groups)
        changes = sign * (np.array(list(self._pool.map(moved, groups.values()))) - base)
        best = int(np.argmax(changes))
        return float(changes[best]), names[best] if changes[best] > 0.0 else None


def run_audit(
    merged: MergedRobot, ways: Sequence[Way], progress: Callable[[str, int, int], None] = lambda name, done, total: None,
    bend: bool = False, **options: Any,
) -> list[Edge]:
    """Audit every way; see ``Audit`` for the options. ``progress`` is told the edge, how many are done, of how many.

    ``bend``: where a straight way breaks the promise, take it turned if that keeps it better.
    """
    audit, out = Audit(merged, **options), []
    try:
        for way in ways:
            out.append(audit.best(way) if bend else audit.along(way))
            progress(f"{way.start} to {way.end}", len(out), len(ways))
    finally:
        audit.close()
    return out


def verdict(edges: Sequence[Edge]) -> str:
    """One line on what an audit found."""
    broken = [(edge, edge.violations[0]) for edge in edges if edge.violations]
    kept = [edge for edge in edges if edge.reserve is None]
    turned = [f"{edge.way.start} to {edge.way.told}" for edge in edges if edge.way.turn is not None]
    bends = f" (bent: {'; '.join(turned)})" if turned else ""
    if not broken:
        parts = [min(robot.grip_n for robot in e.robots.values()) / max(min(r.grip_n for r in e.ends), 1e-9) for e in kept]
        weakest = f", grip at least {min(parts):.2f} of the weaker end's" if parts else ""
        return f"audit: what the robots can do changes evenly along all {len(kept)} edges{weakest}{bends}"
    edge, worst = max(broken, key=lambda pair: pair[1].excess)
    where = f"{edge.way.start} to {edge.way.end}"
    return f"audit: {len(broken)} of {len(edges)} edges lead through worse robots; worst from {where}: {worst.sentence()}{bends}"
