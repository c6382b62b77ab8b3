"""What goes wrong on a cluster of real nodes, each begun by `ray start` in processes of its own: the episodes come out the same, once each.

The robots are toys whose policy dawdles, so that there is a middle in which something can happen.
"""

import os
import signal
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from ray_nodes import Nodes, assert_same
from toys import CRAWL, CRAWLER_ROBOTS

from toolkit.errors import ToolkitError
from toolkit.morphology.lab import Lab
from toolkit.simulation import cluster as module
from toolkit.simulation.cluster import Cluster
from toolkit.simulation.rollout import RolloutEngine

pytestmark = pytest.mark.slow
PATIENT = {"patience": 60.0, "start": 120.0}


@pytest.fixture
def nodes(tmp_path, wait_for):
    """Makes a cluster of nodes with so many processors each, the head first."""
    made = Nodes(tmp_path)

    def begin(*processors):
        made.start(processors[0], head=True)
        wait_for(lambda: module._answers(made.address), 60.0)
        for count in processors[1:]:
            made.start(count)
        return made

    yield begin
    made.end()


@pytest.fixture(scope="module")
def lab():
    return Lab(CRAWLER_ROBOTS[0], CRAWLER_ROBOTS[1:], CRAWL)


def dawdling(observation, rng):
    time.sleep(0.01)
    return rng.uniform(-1.0, 1.0, 3)


@pytest.fixture(scope="module")
def batch(lab):
    """(actors, alphas, seeds) of 24 episodes."""
    source, target = lab.space.beta("crawler"), lab.space.beta("long")
    return [dawdling] * 24, [source + share * (target - source) for share in np.linspace(0, 1, 24)], list(range(24))


@pytest.fixture(scope="module")
def wanted(lab, batch):
    engine = RolloutEngine(lab.merged, threads=8)
    yield engine.play(*batch)
    engine.close()


@contextmanager
def playing(address, lab, after=3, strike=lambda remote: None, **settings):
    """An engine on the cluster; ``strike`` is called, aside, with the actor that gave the answer number ``after``."""
    cluster, given = Cluster(address, **PATIENT | settings), []
    give_back = cluster.give_back

    def counted(remote):
        give_back(remote)
        given.append(remote)
        if len(given) == after + 1:  # the first is the one by which the scene is admitted
            threading.Thread(target=strike, args=(remote,), daemon=True).start()

    cluster.give_back = counted
    try:
        engine = cluster.merged(lab)
        yield cluster, engine, given
        engine.close()
    finally:
        cluster.close()


def pid_of(cluster, remote):
    return cluster._ray.get(remote.actor.__ray_call__.remote(lambda player: os.getpid()), timeout=30.0)


def test_a_worker_that_is_killed_is_replaced(nodes, lab, batch, wanted, wait_for):
    """Its process, by the kernel; the node lives."""
    here, pids = nodes(2), {}
    with playing(here.address, lab, strike=lambda remote: os.kill(pids[remote], signal.SIGKILL)) as (cluster, engine, _):
        cluster.wait()
        pids |= {remote: pid_of(cluster, remote) for remote in cluster._held}
        assert_same(engine.play(*batch), wanted)
        assert engine.episodes_played == 24 and cluster.lost == 1
        wait_for(lambda: cluster.ready == 2, 60.0)


def test_a_straggler_is_waited_for_no_longer_than_patience(nodes, lab, batch, wanted):
    """A process that stands still: its episode is played by another, and what it would have answered is not counted."""
    here, pids = nodes(2), {}
    with playing(here.address, lab, strike=lambda remote: os.kill(pids[remote], signal.SIGSTOP), patience=4.0) as (cluster, engine, given):
        cluster.wait()
        pids |= {remote: pid_of(cluster, remote) for remote in cluster._held}
        began = time.monotonic()
        assert_same(engine.play(*batch), wanted)
        assert engine.episodes_played == 24 and cluster.lost == 1
        assert time.monotonic() - began < 60.0, "it was waited for"
        assert len(given) == 1 + 24, "an answer counts once"


def test_a_node_that_joins_plays(nodes, lab, batch, wanted, monkeypatch):
    monkeypatch.setattr(module, "LOOK", 0.5)
    here = nodes(1)
    with playing(here.address, lab, strike=lambda remote: here.start(1)) as (cluster, engine, given):
        found, began = engine.play(*batch), time.monotonic()
        while len({remote.node for remote in given}) < 2:
            assert time.monotonic() - began < 120.0, "the node that joined never played"
            assert_same(found, wanted)
            found = engine.play(*batch)
        assert_same(found, wanted)
        assert cluster.lost == 0 and engine.episodes_played == len(given) - 1


def test_a_head_that_comes_back_is_connected_to_again(nodes, lab, batch, wanted, monkeypatch):
    """All that was under way is played again, as nothing of it was answered."""
    monkeypatch.setattr(module, "LOOK", 0.5)
    here = nodes(2)
    began_again = threading.Event()

    def strike(remote):
        here.kill(here.processes[0])
        time.sleep(3.0)
        here.start(2, head=True)
        began_again.set()

    with playing(here.address, lab, strike=strike, gone=6.0) as (cluster, engine, given):
        cluster.wait()
        first = cluster._held[0].connection
        assert_same(engine.play(*batch), wanted)
        assert began_again.is_set() and engine.episodes_played == 24
        assert cluster._connection == first + 1 and {remote.connection for remote in given} == {first, first + 1}


def test_a_head_that_stays_away_ends_the_run_with_a_sentence(nodes, lab, batch, monkeypatch):
    monkeypatch.setattr(module, "LOOK", 0.5)
    here = nodes(2)
    with playing(here.address, lab, strike=lambda remote: here.kill(here.processes[0]), gone=4.0) as (cluster, engine, _):
        cluster.wait()
        cluster._start = 5.0
        began = time.monotonic()
        with pytest.raises(ToolkitError, match=rf"the head of the Ray cluster at {here.address} has gone and not come back .* --resume"):
            engine.play(*batch)
        assert time.monotonic() - began < 60.0


def test_a_cluster_that_has_become_too_small_says_so(nodes, lab, batch):
    """The head has no processor of its own, and the only node that has one goes."""
    here = nodes(0, 1)
    with playing(here.address, lab, strike=lambda remote: here.kill(here.processes[1])) as (cluster, engine, _):
        cluster._start = 5.0
        with pytest.raises(ToolkitError, match="has had no processor free for an episode for 5 s; look at `ray status`, add a node"):
            engine.play(*batch)
