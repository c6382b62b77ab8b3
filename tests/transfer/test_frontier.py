"""How far a run has come: killed anywhere, in any order or side by side, it ends as the unbroken one; other checkpoints are refused."""

import threading
import time

import numpy as np
import pytest
from toy_transfer import SOURCE, TARGETS, THREE, Killed, Toy, assert_same_end, config, expert, natives, timeless, transfer_of

from toolkit.errors import ToolkitError
from toolkit.evolution import Terminal
from toolkit.learning.policy import GaussianPolicy, ValueFunction
from toolkit.runs.run import Run
from toolkit.transfer.meta_evolve import Transfer

pytestmark = pytest.mark.usefixtures("unhurried")
RESUMED = config(native=True, check_every=2)


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """(transfer, calls of its engine, calls of its native robots) of a run that nobody killed."""
    toy, others = Toy(), natives()
    transfer = transfer_of(tmp_path_factory.mktemp("unbroken") / "run", RESUMED, toy, native=others)
    transfer.meta_evolve()
    return transfer, len(toy.calls), [len(other.calls) for other in others.values()]


@pytest.mark.parametrize("share", [0.0, 0.02, 0.35, 0.98])
def test_killed_in_a_rollout_and_resumed_is_the_same_run(tmp_path, unbroken, share):
    whole, calls, _ = unbroken
    kill = int(share * calls)
    with pytest.raises(Killed):
        transfer_of(tmp_path / "run", RESUMED, Toy(kill_after=kill), native=natives()).meta_evolve()
    resumed = transfer_of(tmp_path / "run", RESUMED, Toy(), resume=True, native=natives())
    resumed.meta_evolve()
    assert_same_end(resumed, whole)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_killed_in_the_last_hop_and_resumed_is_the_same_run(tmp_path, unbroken, share):
    whole, _, (calls, _) = unbroken
    others = natives()
    others["left"].kill_after = int(share * calls)
    with pytest.raises(Killed):
        transfer_of(tmp_path / "run", RESUMED, Toy(), native=others).meta_evolve()
    resumed = transfer_of(tmp_path / "run", RESUMED, Toy(), resume=True, native=natives())
    resumed.meta_evolve()
    assert_same_end(resumed, whole)


@pytest.mark.parametrize("event", ["check", "update", "moved", "split", "arrived"])
def test_killed_right_after_an_event_and_resumed_is_the_same_run(tmp_path, unbroken, event):
    """The record is on disk, the checkpoint is not: the record must not appear twice."""

    def kill(entry, branch):
        if entry.event.name == event and entry.path != "path 1":
            raise Killed

    with pytest.raises(Killed):
        transfer_of(tmp_path / "run", RESUMED, Toy(), native=natives(), report=kill).meta_evolve()
    resumed = transfer_of(tmp_path / "run", RESUMED, Toy(), resume=True, native=natives())
    resumed.meta_evolve()
    assert_same_end(resumed, unbroken[0])


def test_killed_again_and_again_is_the_same_run(tmp_path, unbroken):
    whole, calls, _ = unbroken
    sittings = 0
    while True:
        player = Toy(kill_after=12)
        transfer = transfer_of(tmp_path / "run", RESUMED, player, resume=sittings > 0, native=natives())
        try:
            transfer.meta_evolve()
            break
        except Killed:
            sittings += 1
            assert sittings < calls, "the run does not get anywhere"
    assert sittings > 3, f"{calls} calls were killed only {sittings} times"
    assert_same_end(transfer, whole)


def test_a_finished_run_resumes_to_its_own_end(tmp_path):
    finished = transfer_of(tmp_path / "run", config(), Toy())
    finished.meta_evolve()
    toy = Toy(kill_after=0)
    again = transfer_of(tmp_path / "run", config(), toy, resume=True)
    again.meta_evolve()
    assert_same_end(again, finished)
    assert again.sampler.seconds >= finished.sampler.earlier_seconds


def test_another_seed_is_another_run(tmp_path, unbroken):
    other = config(native=True, check_every=2, seed=1)
    transfer = transfer_of(tmp_path / "run", other, Toy(), native=natives())
    transfer.meta_evolve()
    assert timeless(transfer) != timeless(unbroken[0])


LEARNERS = {"npg": config(native=True, check_every=2), "search": config(learner="search", native=True, path_budget=3_000)}


class Plain(Toy):
    """Plays for several paths at once, and so does not write down whom; each batch takes at least ``pause`` s.

    Attributes:
        batches: played.  most: batches that were played at once, natives' included.
    """

    def __init__(self, pause=0.0, engine=None, **settings):
        super().__init__(**settings)
        self.pause, self.engine = pause, engine or self
        self.batches, self.most, self._now, self._lock = 0, 0, 0, threading.Lock()

    def play(self, actor, alphas, seeds):
        with self.engine._lock:
            self.batches += 1
            assert not self.stopped, "played although it was stopped"
            if self.kill_after is not None and self.batches > self.kill_after:
                raise Killed
            self.engine._now += 1
            self.engine.most = max(self.engine.most, self.engine._now)
        time.sleep(self.pause)
        actors = actor if isinstance(actor, list) else [actor] * len(seeds)
        try:
            return [self.one(*job) for job in zip(actors, alphas, seeds, strict=True)]
        finally:
            with self.engine._lock:
                self.engine._now -= 1


def three(folder, settings, resume=False, kill_after=None, pause=0.0):
    engine, shifts = Plain(pause, kill_after=kill_after), {"left": 0.2, "right": -0.2, "far": 0.1}
    native = {name: Plain(pause, engine, shift=shift) for name, shift in shifts.items()}
    return transfer_of(folder, settings, engine, resume, THREE, native)


def by_path(transfer):
    """Path -> its records, in their order."""
    found = {}
    for record in timeless(transfer):
        found.setdefault(record["path"], []).append(record)
    return found


def assert_same_paths(transfer, other):
    assert by_path(transfer) == by_path(other), "the metrics of a path differ"
    for name, policy in other.arrived.items():
        np.testing.assert_array_equal(transfer.arrived[name].parameters, policy.parameters, err_msg=name)
        for mine, theirs in zip(transfer.arrived[name].layers()[1:], policy.layers()[1:], strict=True):
            np.testing.assert_array_equal(mine, theirs, err_msg=name)
    assert set(transfer.arrived) == set(other.arrived) == {target.name for target in THREE}
    assert transfer.costs == other.costs and transfer.routes == other.routes and list(transfer.costs) == list(other.costs)


@pytest.fixture(scope="module", params=LEARNERS)
def in_turn(request, tmp_path_factory):
    """(settings, a whole run of them, one path after the other)."""
    transfer = three(tmp_path_factory.mktemp("turns") / "run", LEARNERS[request.param])
    transfer.meta_evolve()
    assert len(transfer.costs) >= 4 and transfer.players.engine.most == 1
    return LEARNERS[request.param], transfer


def test_paths_may_be_played_in_any_order(tmp_path, in_turn):
    """Whose turn it is is drawn anew every time: each path comes to the same, bit for bit."""
    settings, whole = in_turn
    transfer, rng, turns = three(tmp_path / "run", settings), np.random.default_rng(3), []

    def turn():
        turns.append(transfer.pending[rng.integers(len(transfer.pending))])
        return turns[-1]

    transfer.frontier.turn = turn
    transfer.meta_evolve()
    order = [branch.path for branch in turns]
    assert any(order.index(path) < len(order) - 1 - order[::-1].index(other) for path in order for other in order if path > other), (
        "the paths were played one after the other all the same"
    )
    assert_same_paths(transfer, whole)


def test_paths_may_be_played_side_by_side(tmp_path, in_turn):
    settings, whole = in_turn
    transfer = three(tmp_path / "run", settings, pause=0.005)
    transfer.meta_evolve(at_once=3)
    assert transfer.players.engine.most > 1, "no two paths were ever played at once"
    assert_same_paths(transfer, whole)


def test_paths_side_by_side_killed_and_resumed_are_the_same_run(tmp_path, in_turn):
    """Killed while several are under way, again and again; the last sitting plays one after the other."""
    settings, whole = in_turn
    total = whole.players.engine.batches
    for sitting, share in enumerate((0.5, 0.3, 0.1)):
        transfer = three(tmp_path / "run", settings, resume=sitting > 0, kill_after=int(share * total), pause=0.001)
        with pytest.raises(Killed):
            transfer.meta_evolve(at_once=3)
        transfer.run.end()
    transfer = three(tmp_path / "run", settings, resume=True)
    transfer.meta_evolve()
    assert_same_paths(transfer, whole)


def killed_run(folder):
    toy = Toy(kill_after=40)
    with pytest.raises(Killed):
        transfer_of(folder, config(), toy).meta_evolve()


def test_a_checkpoint_of_other_dimensions_is_refused(tmp_path):
    killed_run(tmp_path / "run")
    run = Run.open(tmp_path / "run", {})
    flat = Terminal("hand", np.zeros(4)), [Terminal("left", np.ones(4))]
    transfer = Transfer(config(), *flat, *expert(), Toy(), {}, run)
    with pytest.raises(ToolkitError, match="3 evolution dimensions, this space 4; .* start a new run"):
        transfer.restore()


def test_a_checkpoint_of_another_network_is_refused(tmp_path):
    killed_run(tmp_path / "run")
    run, rng = Run.open(tmp_path / "run", {}), np.random.default_rng(0)
    other = GaussianPolicy(["one"], ["a"], rng, hidden=(4,)), ValueFunction(["one"], rng, hidden=(4,))
    transfer = Transfer(config(), SOURCE, TARGETS, *other, Toy(), {}, run)
    with pytest.raises(ToolkitError):
        transfer.restore()


def test_a_torn_checkpoint_is_refused(tmp_path):
    killed_run(tmp_path / "run")
    file = tmp_path / "run" / "checkpoints" / "transfer.safetensors"
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(ToolkitError, match="truncated or damaged"):
        transfer_of(tmp_path / "run", config(), Toy(), resume=True)
