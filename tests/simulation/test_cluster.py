"""Episodes played by Ray's actors on a cluster of two nodes: the same bits as of this machine's engine, whoever is killed meanwhile."""

import socket
import sys
import threading
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from ray_nodes import assert_same, ray

from robots import MODEL_ROBOTS, ROBOTS
from tasks import MODEL_TASKS
from toolkit.errors import ToolkitError
from toolkit.evaluation.success import evaluate_compiled, evaluate_native
from toolkit.expert.practice import PracticeConfig, practise
from toolkit.expert.shelf import load_expert
from toolkit.learning.npg import NpgConfig
from toolkit.learning.policy import MeanActor
from toolkit.morphology.lab import Lab
from toolkit.runs.provenance import code_digest, recorded_versions
from toolkit.runs.run import Run
from toolkit.simulation import cluster as module
from toolkit.simulation.cluster import Cluster, Scene
from toolkit.simulation.rollout import NativeEngine, RolloutEngine
from toolkit.transfer.meta_evolve import Transfer
from toolkit.transfer.settings import TransferConfig

TARGET = "kinova3"
TIMING = {"episodes_per_s", "play_s", "learn_s", "seconds"}
SMALL = {"object_store_memory": 100 * 2**20}


@pytest.fixture(scope="module")
def lab(task):
    return Lab(ROBOTS["adroit"], [ROBOTS[TARGET], ROBOTS["jaco"]], task)


@pytest.fixture(scope="module")
def nodes():
    """A cluster of two nodes with a processor each, in processes of this machine."""
    from ray.cluster_utils import Cluster as Nodes

    made = Nodes(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False, **SMALL})
    made.add_node(num_cpus=1, **SMALL)
    ray.init(address=made.address, log_to_driver=False, logging_level="ERROR")
    yield made
    ray.shutdown()
    made.shutdown()


@pytest.fixture(scope="module")
def cluster(nodes, lab, wait_for):
    made = Cluster(nodes.address, actors=2)  # a node that a test adds is for the test
    made.merged(lab).close()
    wait_for(lambda: made.ready == 2, 300.0)
    yield made
    made.close()


@pytest.fixture(scope="module")
def batch(lab, restless):
    """(actors, alphas, seeds) of eight short episodes on robots between source and target."""
    source, target = (lab.space.beta(name) for name in ("adroit", TARGET))
    policies = [restless(k) for k in range(4)]
    actors = [policy.act for policy in policies] + [MeanActor(policy) for policy in policies]
    return actors, [source + share * (target - source) for share in np.linspace(0, 1, 8)], list(range(100, 108))


@pytest.fixture(scope="module")
def local(lab, batch):
    engine = RolloutEngine(lab.merged)
    yield engine.play(*batch)
    engine.close()


@pytest.mark.slow
def test_two_nodes_play_the_same_bits(cluster, lab, batch, local):
    assert len({remote.node for remote in cluster._held}) == 2, "both actors stand on one node"
    engine = cluster.merged(lab)
    assert_same(engine.play(*batch), local)
    assert engine.episodes_played == 8 and cluster.lost == 0
    engine.close()


@pytest.mark.slow
def test_the_unmodified_robot_plays_the_same_bits(cluster, task, batch):
    actors, alphas, seeds = (part[:3] for part in batch)
    here, there = NativeEngine(ROBOTS[TARGET], task), cluster.native(ROBOTS[TARGET], task)
    assert_same(there.play(actors, alphas, seeds), here.play(actors, alphas, seeds))
    here.close(), there.close()


@pytest.mark.slow
def test_success_on_the_unmodified_robots_own_step_is_the_same(cluster, task):
    """Outcomes of the shipped expert, which succeeds on some seeds only."""
    expert, _ = load_expert("adroit", task)
    here = evaluate_native(expert, ROBOTS[TARGET], task, 4, processes=1)
    assert evaluate_native(expert, ROBOTS[TARGET], task, 4, cluster=cluster) == here
    assert evaluate_compiled(expert, ROBOTS[TARGET], task, 4, cluster=cluster) == evaluate_compiled(expert, ROBOTS[TARGET], task, 4)


@pytest.mark.slow
def test_a_transfer_on_the_cluster_side_by_side_is_the_local_one(cluster, lab, task, tmp_path):
    """A small one of an expert that misses, whose budget is soon spent: the same costs and policies, and of each path the same metrics."""
    expert, value = load_expert("adroit", task)
    parameters = expert.parameters.copy()
    parameters[-2 * len(expert.action_names)] += 0.6  # bias of the first action entry
    expert.set_parameters(parameters)
    config = TransferConfig(kind="independent", xi=4.0, check_episodes=2, goal_episodes=2, path_budget=4, check_every=1, native=False,
                            npg=NpgConfig(batch_size=4))

    def played(folder, engine, at_once):
        transfer = Transfer(config, *lab.terminals(), expert.copy(), value.copy(), engine, {}, Run.create(folder, {}))
        policies = transfer.meta_evolve(at_once)
        engine.close()
        told = [{key: value for key, value in record.items() if key not in TIMING} for record in transfer.run.read_metrics()]
        return policies, transfer.costs, {path: [record for record in told if record["path"] == path] for path in transfer.costs}

    (mine, costs, told), (theirs, others, heard) = (
        played(tmp_path / "far", cluster.merged(lab), 2), played(tmp_path / "here", RolloutEngine(lab.merged), 1))
    assert costs == others and told == heard and sum(cost.train_iterations for cost in costs.values()) > 0
    for name in (TARGET, "jaco"):
        np.testing.assert_array_equal(mine[name].parameters, theirs[name].parameters, err_msg=name)


@pytest.mark.slow
def test_an_expert_that_learns_from_nothing_learns_the_same(cluster):
    """On an easier task, on starts all over the way, and measured on the task itself: three scenes of one robot."""
    ant, maze = MODEL_ROBOTS["ant"], MODEL_TASKS["ant-maze"]
    short = PracticeConfig(practice=1, updates=1, check_every=1, checks=2)
    short = replace(short, first=replace(short.first, batch_size=2), then=replace(short.then, batch_size=2))
    found = []
    for engine in (NativeEngine(ant, maze, threads=1), cluster.native(ant, maze)):
        policy, value, card = practise(engine, maze, short)
        found.append((np.concatenate([policy.parameters, *policy.layers()[1:3], value.parameters]), card))
        engine.close()
    np.testing.assert_array_equal(found[0][0], found[1][0])
    assert found[0][1] == found[1][1] and found[0][1]["updates"] == 1


@pytest.mark.slow
def test_an_actors_error_is_the_callers(cluster, lab, batch):
    """A sentence of the toolkit stays one, and the actor goes on."""

    def broken(observation, rng):
        raise ToolkitError("this policy does not act")

    engine = cluster.merged(lab)
    with pytest.raises(ToolkitError, match="this policy does not act"):
        engine.play(broken, batch[1][:1], [0])
    assert cluster.ready == 2
    engine.close()


def assert_refused(nodes, lab, said):
    """A node that joins is no place for an actor, and the sentence says why."""
    node = nodes.add_node(num_cpus=1, **SMALL)
    with closing(Cluster(nodes.address, actors=1)) as other, pytest.raises(ToolkitError, match=said):
        other.merged(lab)
    nodes.remove_node(node)


@pytest.mark.slow
def test_a_node_with_other_code_is_refused_by_name(nodes, lab, monkeypatch, cluster):
    """As seen from a machine whose own code is another; the engine's own actors, of the same code, have passed."""
    monkeypatch.setattr(module, "code_digest", lambda: "0" * 64)
    assert_refused(nodes, lab, rf"node {socket.gethostname()} has code of the toolkit {code_digest()[:12]}, this machine 000000")


@pytest.mark.slow
def test_a_node_with_other_versions_is_refused_by_name(nodes, lab, monkeypatch, cluster):
    """As seen from a machine with another MuJoCo: the actor's own answer is what is compared."""
    monkeypatch.setattr(module, "recorded_versions", lambda: recorded_versions() | {"mujoco": "3.6.0"})
    version = recorded_versions()["mujoco"]
    assert_refused(nodes, lab, rf"node {socket.gethostname()} has mujoco {version}, this machine 3.6.0; install the same on all nodes")


@pytest.mark.slow
def test_a_node_that_plays_other_bits_is_refused_by_name(cluster, task, monkeypatch):
    """Of a scene that is new to the cluster, before any of its episodes counts; the cluster's others were proven before."""
    monkeypatch.setattr(module, "numbers", lambda engine: "0" * 12)
    with pytest.raises(ToolkitError, match=f"node {socket.gethostname()} has this machine's versions but plays an episode to other bits"):
        engine = cluster.native(ROBOTS["jaco"], task)
        engine.play(MeanActor(load_expert("adroit", task)[0]), [np.zeros(1)], [0])
    cluster._refusal = ""
    cluster._scenes.remove(Scene((ROBOTS["jaco"],), task, native=True))


def test_nobody_at_the_address(monkeypatch):
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    with pytest.raises(ToolkitError, match=rf"no Ray cluster answers at 127.0.0.1:{port} .*begin one with `ray start --head`"):
        Cluster(f"127.0.0.1:{port}")
    with pytest.raises(ToolkitError, match="'nowhere' is no address; give auto, or HOST:PORT"):
        Cluster("nowhere")


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ToolkitError, match=r"pip install 'meta-evolve\[ray\]'"):
        Cluster("auto")


def playing(cluster, lab, batch, strike):
    """Two batches' episodes, and the cluster's engine; ``strike`` is called with the actor that gave the third answer."""
    engine, done, given = cluster.merged(lab), [], cluster.give_back

    def give_back(remote):
        done.append(remote)
        if len(done) == 3:
            strike(remote)
        given(remote)

    cluster.give_back = give_back
    actors, alphas, seeds = batch
    try:
        return engine.play(actors * 2, alphas * 2, seeds + seeds), engine
    finally:
        cluster.give_back = given
        engine.close()


@pytest.mark.slow
def test_an_actor_killed_in_the_middle_changes_nothing(cluster, lab, batch, local, wait_for):
    """What it was given is played again by another one, and counted once."""
    before = cluster.lost
    found, engine = playing(cluster, lab, batch, lambda remote: ray.kill(remote.actor))
    assert_same(found, [*local, *local])
    assert engine.episodes_played == 16 and cluster.lost == before + 1
    wait_for(lambda: cluster.ready == 2, 300.0)


@pytest.mark.slow
def test_an_episode_with_which_actors_die_again_and_again_ends_the_run(cluster, lab, batch, monkeypatch, wait_for):
    monkeypatch.setattr(module, "ATTEMPTS", 1)
    with pytest.raises(ToolkitError, match="1 actors of the Ray cluster at .* were lost in turn with the episode of seed 1.*--resume"):
        playing(cluster, lab, batch, lambda remote: ray.kill(remote.actor))
    wait_for(lambda: cluster.ready == 2, 300.0)


@pytest.mark.slow
def test_a_node_removed_in_the_middle_changes_nothing(nodes, cluster, lab, batch, local, monkeypatch, wait_for):
    """It is not held against the episodes that were played there; a node that joins is used again."""
    monkeypatch.setattr(module, "ATTEMPTS", 1)
    (node,) = nodes.worker_nodes
    before = cluster.lost
    strike = lambda remote: threading.Thread(target=nodes.remove_node, args=(node,), daemon=True).start()  # noqa: E731
    found, _ = playing(cluster, lab, batch, strike)
    assert_same(found, [*local, *local])
    wait_for(lambda: len([one for one in ray.nodes() if one["Alive"]]) == 1, 60.0)
    found, _ = playing(cluster, lab, batch, lambda remote: None)
    assert_same(found, [*local, *local])
    assert cluster.lost == before + 1, "the actor of the node that is gone"
    nodes.add_node(num_cpus=1, **SMALL)
    wait_for(lambda: cluster.ready == 2, 300.0)
    assert len({remote.node for remote in cluster._held}) == 2


@pytest.mark.slow
def test_a_cluster_without_room_says_so(nodes, lab, cluster):
    """All processors are taken by the first cluster's actors."""
    said = r"has had no processor free for an episode for 3 s; look at `ray status`"
    with closing(Cluster(nodes.address, start=3.0)) as other, pytest.raises(ToolkitError, match=said):
        other.merged(lab)
