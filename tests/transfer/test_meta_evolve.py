"""Algorithm 1 on a toy whose every number can be checked: three dimensions, one action, and a success that is measured.

The robot alpha succeeds if its action lies within a tolerance of `wanted(alpha)`, and only then is it rewarded, once.
Some seeds are harder than others, so that success is a rate: at an error of TOLERANCE none succeeds. The observation is
always the same, so a policy is one number, and the natural policy gradient has to move that number
along as the robots move: from 0.1 at the source to 0.96 at the meta robot, then to 1.36 or back to 0.47.
"""

import dataclasses
import itertools
import json
import math
import os
import threading
import time

import numpy as np
import pytest

from toolkit.errors import ToolkitError
from toolkit.evolution import Terminal, evolution_tree
from toolkit.evolution.bend import Bend
from toolkit.inspection.drawn_tree import Plan
from toolkit.learning.episode import Episode
from toolkit.learning.exploration import Explored, Gain, SearchConfig
from toolkit.learning.npg import NpgConfig
from toolkit.learning.policy import GaussianPolicy, ValueFunction
from toolkit.runs.run import Run
from toolkit.runs.seeds import CHECKING_SEEDS, EVALUATION_SEEDS, TRAINING_SEEDS
from toolkit.transfer.branch import path_generator
from toolkit.transfer.events import Checked
from toolkit.transfer.meta_evolve import Transfer
from toolkit.transfer.settings import TransferConfig

SOURCE = Terminal("hand", np.zeros(3))
TARGETS = [Terminal("left", np.array([0.8, 0.6, 0.2])), Terminal("right", np.array([0.8, 0.2, 0.9]))]
META = np.array([0.8, 0.2, 0.2])
WEIGHTS = np.array([1.0, 1.0, -0.7])
TOLERANCE = 0.15
OBSERVATION = np.ones(1)
TIMING = {"episodes_per_s", "play_s", "learn_s", "seconds"}
EXPLORED = Explored(np.array([0.2]), np.zeros(1))
NPG = NpgConfig(step_size=0.1, min_log_std=-2.6, cg_iterations=4, value_epochs=2)


def wanted(alpha):
    """The one action that the robot alpha (3,) should take."""
    return float(WEIGHTS @ alpha) + 0.1


@pytest.fixture(scope="module", autouse=True)
def unhurried():
    """The disk need not have it before the next line: no test here cuts the power."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: None)
        yield


def tolerance(seed):
    """How far from wanted an episode of this seed may act: 0.5 to 1 of TOLERANCE."""
    return TOLERANCE * (0.5 + 0.5 * (seed * 5 % 12 + 1) / 12)


class Killed(Exception):
    """What stands for a kill."""


class Toy:
    """Plays the toy, and writes down whom it played.

    Attributes:
        calls: (branch, training or not, alphas, seeds) per batch, the branch as it was when it asked.
        episodes: played.
    """

    def __init__(self, kill_after=None, succeeds=True, shift=0.0):
        self.kill_after, self.succeeds, self.shift = kill_after, succeeds, shift
        self.calls, self.episodes, self.transfer, self.stopped = [], 0, None, False

    def play(self, actor, alphas, seeds):
        if self.kill_after is not None and len(self.calls) >= self.kill_after:
            raise Killed
        branch = self.transfer.pending[-1]
        actors = actor if isinstance(actor, list) else [actor] * len(seeds)
        noisy = len({float(actors[0](OBSERVATION, np.random.default_rng(i))[0]) for i in range(3)}) > 1
        state = {
            "path": branch.path, "alpha": branch.alpha, "next": branch.next_alpha, "window": branch.window,
            "stage": branch.stage, "training": max(seeds) < TRAINING_SEEDS, "noisy": noisy,
            "alphas": np.array(alphas), "seeds": list(seeds),
        }
        self.calls.append(state)
        self.episodes += len(seeds)
        return [self.one(*job) for job in zip(actors, alphas, seeds, strict=True)]

    def stop(self):
        self.stopped = True

    def one(self, actor, alpha, seed):
        action = actor(OBSERVATION, np.random.default_rng((seed, 1)))
        success = self.succeeds and abs(float(action[0]) - wanted(alpha) - self.shift) < tolerance(seed)
        return Episode(
            observations=OBSERVATION[None], actions=action[None], rewards=np.array([float(success)]), success=success,
            diverged=False, terminated=True, last_observation=OBSERVATION, alpha=alpha, seed=seed,
        )

    def of(self, training):
        return [call for call in self.calls if call["training"] is training]


def easy_toy():
    """All its robots want what the source wants."""
    toy = Toy()
    toy.one = lambda actor, alpha, seed: Toy.one(toy, actor, np.zeros(3), seed)
    return toy


def expert():
    """A policy that succeeds on the source, and a value function."""
    rng = np.random.default_rng(5)
    policy = GaussianPolicy(["one"], ["a"], rng, hidden=(8,), init_log_std=-2.2)
    value = ValueFunction(["one"], rng, hidden=(8,))
    bias = policy.parameters.copy()
    bias[-2] += wanted(SOURCE.alpha) - float(policy.mean(OBSERVATION)[0])
    policy.set_parameters(bias)
    return policy, value


def seeing_expert():
    """As `expert`, but nearly linear in what it sees: an offset of its one observation moves its action by as much."""
    policy, value = expert()
    policy.set_parameters(np.concatenate([np.full(8, 0.1), np.zeros(8), np.full(8, 10 / 8), [0.0], policy.log_std]))
    policy.set_normalisation(policy.mean(OBSERVATION) - wanted(SOURCE.alpha), np.ones(1))
    return policy, value


def config(**changes):
    return TransferConfig(**{"npg": NPG, "check_episodes": 12, "goal_episodes": 12, "xi": 0.08, "native": False} | changes)


def transfer_of(folder, settings, player, resume=False, targets=TARGETS, native=None, report=None, on_batch=None, bends=None,
                explored=EXPLORED):
    """A Transfer in a run folder, and the run."""
    run = Run.open(folder, {}) if resume else Run.create(folder, {})
    native = {name: (lambda toy=toy: toy) for name, toy in (native or {}).items()}
    quiet = lambda *seen: None  # noqa: E731
    learner = expert() if settings.learner == "npg" else seeing_expert()
    transfer = Transfer(settings, SOURCE, list(targets), *learner, player, native, run, report or quiet, on_batch or quiet, explored,
                        bends)
    for toy in (player, *(maker() for maker in native.values())):
        toy.transfer = transfer
    if resume:
        transfer.restore()
    return transfer


def records(transfer, event=None):
    return [r for r in transfer.run.read_metrics() if event in (None, r["event"])]


def error_at(policy, alpha):
    return abs(float(policy.mean(OBSERVATION)[0]) - wanted(alpha))


def share_on_segment(alphas, start, end):
    """Where alphas (N, 3) project onto the segment from start to end, as shares (N,), and how far they lie off it."""
    way = end - start
    if np.linalg.norm(way) < 1e-12:
        return np.ones(len(alphas)), np.linalg.norm(alphas - end, axis=1).max()
    shares = (alphas - start) @ way / (way @ way)
    return shares, np.linalg.norm(alphas - start - shares[:, None] * way, axis=1).max()


@pytest.fixture(scope="module", params=["adaptive", "fixed"])
def finished(request, tmp_path_factory):
    """(transfer, toy) after a whole run."""
    toy = Toy()
    transfer = transfer_of(tmp_path_factory.mktemp(request.param) / "run", config(step=request.param), toy)
    transfer.meta_evolve()
    return transfer, toy


# -- Algorithm 1 ---------------------------------------------------------------------------------------------


def test_the_toy_is_no_gift():
    """The expert holds on the source and nowhere that matters, and no one policy serves both targets."""
    policy, _ = expert()
    assert error_at(policy, SOURCE.alpha) < 1e-12
    far = {t.name: error_at(policy, t.alpha) for t in TARGETS} | {"meta": error_at(policy, META)}
    assert min(far.values()) > 2 * TOLERANCE, far
    apart = abs(wanted(TARGETS[0].alpha) - wanted(TARGETS[1].alpha))
    assert apart > 2 * TOLERANCE, f"the targets want actions only {apart:.2f} apart"


def test_every_target_is_reached_and_learned(finished):
    transfer, _ = finished
    assert set(transfer.arrived) == {"left", "right"} and not transfer.pending
    errors = {t.name: error_at(transfer.arrived[t.name], t.alpha) for t in TARGETS}
    assert max(errors.values()) < TOLERANCE, f"the mean action is off by {errors}"
    assert not records(transfer, "budget")


@pytest.mark.parametrize("finished", ["fixed"], indirect=True)
def test_paths_split_at_the_meta_robot(finished):
    transfer, toy = finished
    assert list(transfer.routes) == ["path 1", "path 1.1", "path 1.2"] and transfer.routes["path 1"] == ["hand"]
    ends = {tuple(transfer.routes[path]) for path in ("path 1.1", "path 1.2")}
    assert ends == {("hand", "meta", "left"), ("hand", "meta", "right")}
    tree = evolution_tree(SOURCE, TARGETS)
    (meta,) = [node.alpha for node in tree.nodes if node.kind == "meta"]
    np.testing.assert_allclose(meta, META, atol=1e-12)
    for path in ("path 1.1", "path 1.2"):
        start = next(call["alpha"] for call in toy.calls if call["path"] == path)
        off = float(np.linalg.norm(start - meta))
        assert off < 1e-9, f"{path} begins {off:.1e} away from the meta robot"


def test_the_answer_was_measured_on_its_target(finished):
    """The last measurement before "arrived" was played on the target, and what it says is what was played."""
    transfer, toy = finished
    log = records(transfer)
    for target in TARGETS:
        end = next(i for i, r in enumerate(log) if r["event"] == "arrived" and r["target"] == target.name)
        check = log[end - 1]
        assert check["event"] == "check" and check["held"] and check["success"] >= transfer.config.goal
        last = [call for call in toy.of(training=False) if call["path"] == check["path"]][-1]
        off = float(np.abs(last["alphas"] - target.alpha).max())
        assert off < 1e-9, f"success at {target.name} was measured {off:.1e} away from it"


def test_checks_say_what_was_played(finished):
    transfer, toy = finished
    checks = iter(toy.of(training=False))
    for record in (r for r in records(transfer) if r["event"] in ("check", "look", "explore")):
        played = []
        while len(played) < record["checked"]:
            played += next(checks)["seeds"]
        assert len(played) == record["checked"]
        wanted = transfer.config.noisy_threshold if record["event"] == "explore" else transfer.config.threshold
        assert not record["held"] or record["success"] >= wanted
    assert next(checks, None) is None, "a measurement was played but not written down"


def test_the_way_goes_on_only_where_the_exploring_policy_succeeds_too(finished):
    """Before every move: the mean action and the policy under noise, each at its threshold, on the very robot that is next.

    Adaptive steps ask the mean action alone at a target, where nothing follows.
    """
    transfer, toy = finished
    told = [r for r in records(transfer) if r["event"] in ("check", "look", "explore", "moved")]
    calm = [r for i, r in enumerate(told) if not (r["event"] == "explore" and i + 1 < len(told) and told[i + 1]["event"] == "explore")]
    moves = [calm[i - 2 : i + 1] for i, record in enumerate(calm) if record["event"] == "moved"]
    assert moves
    for before, last, moved in moves:
        if last["event"] == "explore":
            assert before["event"] in ("check", "look") and before["reach"] == last["reach"]
            assert before["success"] >= transfer.config.threshold and last["success"] >= transfer.config.noisy_threshold
        else:
            alone = transfer.routes[moved["path"]][-1] in ("left", "right")
            assert alone and moved["distance"] < 1e-9 and transfer.config.step == "adaptive", moved
            assert last["held"] and last["success"] >= transfer.config.threshold
    checks = toy.of(training=False)
    assert {call["noisy"] for call in checks} == {True, False}
    assert sum(len(call["seeds"]) for call in checks if call["noisy"]) == sum(r["checked"] for r in told if r["event"] == "explore")


def test_where_a_robot_gives_signal_training_begins_there(tmp_path):
    """The first stride on which the policy does not hold, but succeeds often enough under noise, is trained on: no shorter one is tried."""
    toy = Toy()
    transfer = transfer_of(tmp_path / "run", config(signal=0.1), toy)
    transfer.meta_evolve()
    told = [r for r in records(transfer) if r["event"] in ("check", "explore", "update")]
    begun = [told[i - 2 : i] for i, r in enumerate(told) if r["event"] == "update" and told[i - 1]["event"] == "explore"]
    assert any(
        mean["reach"] == noisy["reach"] > transfer.config.xi + 1e-9 and not (mean["held"] and noisy["held"]) and noisy["success"] >= 0.1
        for mean, noisy in begun
    ), "no long stride was trained on"


def test_calming_and_rousing_scale_the_noise_and_nothing_else(tmp_path):
    transfer = transfer_of(tmp_path / "run", config(calm=0.5, least_noise=0.25), Toy())
    (branch,) = transfer.pending
    first, mean = branch.policy.log_std, branch.policy.mean(OBSERVATION)
    assert not transfer.training.weights.rouse(branch), "the first noise is the most"
    shares = []
    while transfer.training.weights.calm(branch):
        shares.append(branch.noise)
        np.testing.assert_allclose(branch.policy.log_std, first + np.log(branch.noise), rtol=0, atol=1e-12)
    assert shares == [0.5, 0.25], "not halved down to a quarter"
    shares = []
    while transfer.training.weights.rouse(branch):
        shares.append(branch.noise)
    assert shares == [0.5, 1.0]
    np.testing.assert_allclose(branch.policy.log_std, first, rtol=0, atol=1e-12)
    assert np.array_equal(branch.policy.mean(OBSERVATION), mean)


def test_there_is_less_noise_where_it_alone_stands_in_the_way(tmp_path):
    """Robots that all want what the source wants: less noise is all that it takes, at once, and no training."""
    toy = easy_toy()
    transfer = transfer_of(tmp_path / "run", config(least_noise=0.05), toy)
    transfer.pending[0].policy.set_log_std(np.array([-1.0]))  # more than TOLERANCE bears
    transfer.look_ahead._leave = lambda branch, step: []  # every target holds already
    transfer.meta_evolve()
    told = [r for r in records(transfer) if r["event"] in ("check", "explore")]
    assert all(0.05 <= r["noise"] <= 1.0 for r in told)
    calmed = [(a, b) for a, b in itertools.pairwise(told) if b["event"] == "explore" == a["event"]]
    assert calmed, "noise never stood in the way"
    for before, after in calmed:
        assert after["noise"] == pytest.approx(max(0.8 * before["noise"], 0.05)) and not before["held"]
    assert not records(transfer, "update")
    assert set(transfer.arrived) == {"left", "right"}


def test_fixed_steps_leave_the_noise_to_training(tmp_path):
    transfer = transfer_of(tmp_path / "run", config(step="fixed"), Toy())
    transfer.meta_evolve()
    assert {r["noise"] for r in records(transfer) if "noise" in r} == {1.0}


def test_a_measurement_stops_early_without_changing_its_outcome(tmp_path):
    """The rate on the way and the goal alike, at every error from none to hopeless."""
    toy = Toy()
    transfer = transfer_of(tmp_path / "run", config(), toy)
    branch, saved = transfer.pending[0], 0
    for error in np.linspace(0.001, TOLERANCE + 0.001, 25):
        alpha = np.array([error, 0.0, 0.0])
        rate = np.mean([error < tolerance(CHECKING_SEEDS + i) for i in range(24)])
        for needed in (0.5, 2 / 3, 0.85, 1.0):
            before = toy.episodes
            measured = transfer.sampler.success(branch, toy, alpha, needed, 24)
            assert (measured >= needed) is bool(rate >= needed - 1e-9), (error, rate, needed)
            saved += 24 - (toy.episodes - before)
    assert transfer.costs["path 1"].check_episodes == toy.episodes
    assert saved > 0, "no measurement stopped early"


def test_siblings_own_their_policies(tmp_path):
    transfer = transfer_of(tmp_path / "run", config(), Toy())
    branch = transfer.pending[0]
    branch.alpha = META
    second, first = transfer.split(branch, transfer.way.evolution_tree(branch))
    networks = [network for b in (first, second, branch) for network in (b.policy, b.value)]
    before = [network.parameters.copy() for network in networks]
    for changed in range(2):
        networks[changed].set_parameters(before[changed] + 1.0)
        networks[changed].set_normalisation(np.full(1, 3.0), np.full(1, 2.0))
    for i in range(2, 6):
        np.testing.assert_array_equal(networks[i].parameters, before[i])
        assert float(networks[i].layers().shift[0]) == 0.0
    transfer.frontier.replace(branch, [second, first])
    assert [branch.targets for branch in transfer.pending] == [["right"], ["left"]], "the first target goes first"


def test_the_last_hop_is_trained_like_any_phase(tmp_path):
    """The native robot wants an action 0.25 beside F(beta)'s: the hop has to learn it, and its episodes count."""
    toy, native = Toy(), Toy(shift=0.25)
    transfer = transfer_of(tmp_path / "run", config(native=True), toy, targets=TARGETS[:1], native={"left": native})
    policy = transfer.meta_evolve()["left"]
    apart = abs(float(policy.mean(OBSERVATION)[0]) - wanted(TARGETS[0].alpha) - 0.25)
    assert apart < TOLERANCE, f"the policy that arrived is {apart:.2f} from what the native robot wants"
    assert native.of(training=True) and {call["stage"] for call in native.calls} == {"settle"}
    assert {call["stage"] for call in toy.calls} == {"evolve"}
    cost = transfer.costs["path 1"]
    assert cost.sim_epochs + cost.check_episodes == toy.episodes + native.episodes
    last = records(transfer)[-2:]
    assert [r["event"] for r in last] == ["check", "arrived"] and last[0]["held"]


@pytest.mark.parametrize("kind", ["steiner", "geometric-median", "independent"])
@pytest.mark.parametrize("metric", ["l1", "l2"])
def test_every_kind_of_tree_is_followed_to_its_ends(tmp_path, kind, metric):
    transfer = transfer_of(tmp_path / "run", config(kind=kind, metric=metric), Toy())
    arrived = transfer.meta_evolve()
    assert max(error_at(arrived[t.name], t.alpha) for t in TARGETS) < TOLERANCE
    assert len(transfer.costs) == 3, f"{list(transfer.costs)}: one shared path and one per target"
    if kind == "independent":
        assert transfer.costs["path 1"].sim_epochs == 0, "independent paths share no way"


def test_direct_trains_on_the_targets_alone(tmp_path):
    """No robot between source and target is played; what is out of the expert's reach is not learned from nothing.

    The expert's demonstrations on the source (DAPG) are given data: played without noise, and not counted.
    """
    near, far = Terminal("near", np.array([0.1, 0.0, 0.0])), TARGETS[0]
    toy = Toy()
    transfer = transfer_of(tmp_path / "run", config(kind="direct", path_budget=120), toy, targets=[near, far])
    arrived = transfer.meta_evolve()
    shown = [call for call in toy.calls if (call["alphas"] == SOURCE.alpha).all()]
    played = np.unique(np.concatenate([call["alphas"] for call in toy.calls if not any(call is one for one in shown)]), axis=0)
    np.testing.assert_array_equal(played, np.unique([near.alpha, far.alpha], axis=0))
    assert len(shown) == 1 and not shown[0]["training"] and len(shown[0]["seeds"]) == 12
    counted = sum(cost.sim_epochs + cost.check_episodes for cost in transfer.costs.values())
    assert counted == toy.episodes - 12
    assert error_at(arrived["near"], near.alpha) < TOLERANCE
    spent = {transfer.routes[path][-1]: cost.sim_epochs for path, cost in transfer.costs.items()}
    assert spent["left"] == 120 and {r["path"] for r in records(transfer, "budget")} == {"path 1.2"}, spent
    assert transfer.costs["path 1"] == type(transfer.costs["path 1"])(), "the shared path of a star costs nothing"


def test_direct_killed_and_resumed_is_the_same_run(tmp_path):
    settings = config(kind="direct", path_budget=60)
    whole = transfer_of(tmp_path / "whole", settings, Toy())
    whole.meta_evolve()
    with pytest.raises(Killed):
        transfer_of(tmp_path / "run", settings, Toy(kill_after=6)).meta_evolve()
    resumed = transfer_of(tmp_path / "run", settings, Toy(), resume=True)
    resumed.meta_evolve()
    assert_same_end(resumed, whole)


def test_direct_needs_an_expert_that_succeeds(tmp_path):
    with pytest.raises(ToolkitError, match="fails 12 times of 12 on hand"):
        transfer_of(tmp_path / "run", config(kind="direct"), Toy(succeeds=False)).meta_evolve()


# -- the optimised path --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def steered(tmp_path_factory):
    """(transfer, toy) after a whole run on optimised paths."""
    toy = Toy()
    settings = config(path="optimised", step="fixed", jacobian_episodes=8)
    transfer = transfer_of(tmp_path_factory.mktemp("steered") / "run", settings, toy)
    transfer.meta_evolve()
    return transfer, toy


def test_an_optimised_path_reaches_every_target(steered):
    transfer, _ = steered
    errors = {t.name: error_at(transfer.arrived[t.name], t.alpha) for t in TARGETS}
    assert max(errors.values()) < TOLERANCE and not records(transfer, "budget"), errors


def test_an_optimised_path_counts_its_jacobians_as_simulation_epochs(steered):
    transfer, toy = steered
    spent = 8 * len(records(transfer, "steered")) + NPG.batch_size * len(records(transfer, "update"))
    assert sum(cost.sim_epochs for cost in transfer.costs.values()) == spent
    assert spent == sum(len(call["seeds"]) for call in toy.of(training=True))
    sampled = [call for call in toy.of(training=True) if len(call["seeds"]) == 8]
    assert len(sampled) == len(records(transfer, "steered")) > 10
    for call in sampled:
        away = np.linalg.norm(call["alphas"] - call["alpha"], axis=1)
        assert (away <= transfer.config.xi + 1e-12).all(), "a robot was sampled farther than a step away"
        assert call["seeds"][0::2] == call["seeds"][1::2], "a pair plays one seed"


def test_steps_of_an_optimised_path_are_no_longer_than_xi_and_come_nearer(steered):
    transfer, _ = steered
    for path in transfer.costs:
        moves = [r for r in records(transfer, "moved") if r["path"] == path]
        assert all(r["stride"] <= transfer.config.xi + 1e-9 for r in moves)
        distances = [r["distance"] for r in moves]
        assert all(b < a for a, b in zip(distances, distances[1:], strict=False) if a > 2 * transfer.config.xi), path
    bent = [r["straight_share"] for r in records(transfer, "steered")]
    assert min(bent) < 0.999, "no step ever left the straight line"
    assert min(bent) >= 0.6 - 1e-9, "a step was bent farther than the estimate is trusted"


@pytest.mark.slow
@pytest.mark.parametrize("step, event", [("fixed", "steered"), ("fixed", "moved"), ("adaptive", "steered")])
def test_an_optimised_path_killed_and_resumed_is_the_same_run(tmp_path, step, event):
    settings = config(path="optimised", step=step, jacobian_episodes=6, xi=0.12)
    whole = transfer_of(tmp_path / "whole", settings, Toy())
    whole.meta_evolve()
    seen = []

    def kill(entry, branch):
        seen.append(entry.event.name)
        if seen.count(event) == 3:
            raise Killed

    with pytest.raises(Killed):
        transfer_of(tmp_path / "run", settings, Toy(), report=kill).meta_evolve()
    resumed = transfer_of(tmp_path / "run", settings, Toy(), resume=True)
    resumed.meta_evolve()
    assert_same_end(resumed, whole)


# -- steps ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("finished", ["fixed"], indirect=True)
def test_fixed_steps_have_length_xi(finished):
    transfer, toy = finished
    strides = {path: [r["stride"] for r in records(transfer, "moved") if r["path"] == path] for path in transfer.costs}
    for path, found in strides.items():
        np.testing.assert_allclose(found[:-1], transfer.config.xi, atol=1e-9, err_msg=path)
        assert 0.0 < found[-1] <= transfer.config.xi + 1e-9, f"{path} ends with a step of {found[-1]}"
    ways = [np.linalg.norm(META), *(np.linalg.norm(t.alpha - META) for t in TARGETS)]
    np.testing.assert_allclose(sorted(sum(found) for found in strides.values()), sorted(ways), atol=1e-9)


def test_adaptive_steps_never_skip_a_robot_on_which_they_do_not_hold(finished):
    """Each move ends where the measurement right before it held, and distances shrink by what was gone."""
    transfer, _ = finished
    log = records(transfer)
    for i, record in enumerate(log):
        if record["event"] == "moved":
            last = next(r for r in reversed(log[:i]) if r["event"] != "split")
            assert last["held"], f"record {i} moves on {last}"
            gone = last["reach"]
            assert abs(gone - record["stride"]) < transfer.config.xi + 1e-9, (gone, record["stride"])


def test_a_bent_way_turns_its_corner_and_its_siblings_go_straight(tmp_path):
    """On the way to the left its second parameter goes first, in steps that never cut the corner; to the meta robot all go at once."""
    toy = Toy()
    bends = {frozenset(["left", "right"]): Bend(SOURCE.alpha, np.array([1]))}
    transfer = transfer_of(tmp_path / "run", config(step="fixed", xi=0.1), toy, bends=bends)
    transfer.meta_evolve()
    assert set(transfer.arrived) == {"left", "right"}
    places = [call["next"] for call in toy.calls if call["path"] == "path 1" and call["next"] is not None]
    assert len(places) > 3
    for place in places:
        assert place[1] == pytest.approx(META[1]) or place[[0, 2]] == pytest.approx([0.0, 0.0]), place
    for path in ("path 1.1", "path 1.2"):
        end = next(t.alpha for t in TARGETS if [t.name] == [r["target"] for r in records(transfer, "arrived") if r["path"] == path])
        for call in toy.calls:
            if call["path"] == path and call["next"] is not None:
                assert share_on_segment(call["next"][None], META, end)[1] < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("lead", [1.0, 0.5])
def test_a_bent_way_killed_and_resumed_is_the_same_run(tmp_path, lead):
    bends = {frozenset(["left", "right"]): Bend(SOURCE.alpha, np.array([1]), lead)}
    whole = transfer_of(tmp_path / "whole", config(step="fixed", xi=0.1), Toy(), bends=bends)
    whole.meta_evolve()
    broken = transfer_of(tmp_path / "broken", config(step="fixed", xi=0.1), Toy(kill_after=9), bends=bends)
    with pytest.raises(Killed):
        broken.meta_evolve()
    again = transfer_of(tmp_path / "broken", config(step="fixed", xi=0.1), Toy(), resume=True, bends=bends)
    again.meta_evolve()
    for name in ("left", "right"):
        np.testing.assert_array_equal(again.arrived[name].parameters, whole.arrived[name].parameters)


def test_a_part_of_a_lead_turns_once_and_where_the_edge_does(tmp_path):
    """The second parameter arrives when the others have gone half of their way, however many phases it takes."""
    toy = Toy()
    bends = {frozenset(["left", "right"]): Bend(SOURCE.alpha, np.array([1]), 0.5)}
    transfer = transfer_of(tmp_path / "run", config(step="fixed", xi=0.1), toy, bends=bends)
    transfer.meta_evolve()
    places = [call["next"] for call in toy.calls if call["path"] == "path 1" and call["next"] is not None]
    turn = np.where(np.arange(3) == 1, META, 0.5 * META)
    off = [min(share_on_segment(place[None], *leg)[1].item() for leg in ((SOURCE.alpha, turn), (turn, META))) for place in places]
    assert len(places) > 3 and max(off) < 1e-9, off
    assert any(np.allclose(place, turn) for place in places)


def test_the_adaptive_step_leaps_where_it_can(tmp_path):
    """Robots that all want the same action are passed in one leap, and cost no training."""
    toy = easy_toy()
    transfer = transfer_of(tmp_path / "run", config(xi=0.01, threshold=0.4), toy, targets=TARGETS[:1])
    transfer.meta_evolve()
    assert not toy.of(training=True)
    moves = records(transfer, "moved")
    assert len(moves) == 1 and moves[0]["trained"] is False and moves[0]["distance"] < 1e-12


@pytest.mark.parametrize("finished", ["adaptive"], indirect=True)
def test_a_step_is_halved_until_it_holds(finished):
    transfer, _ = finished
    reaches, tried = [], 0
    for record in records(transfer):
        if record["event"] == "check":
            reaches.append(record["reach"])
        elif record["event"] != "explore":
            failed = [r for r in reaches if r > transfer.config.xi + 1e-9]
            for longer, shorter in zip(failed, failed[1:], strict=False):
                tried += 1
                assert shorter <= longer / 2 + transfer.config.xi, f"after {longer:.3f} came {shorter:.3f}"
            reaches = []
    assert tried, "no step had to be halved, so the test saw nothing"


# -- what is counted, what is drawn --------------------------------------------------------------------------


def test_costs_count_exactly_what_was_played(finished):
    transfer, toy = finished
    for path, cost in transfer.costs.items():
        mine = [call for call in toy.calls if call["path"] == path]
        trained = [len(call["seeds"]) for call in mine if call["training"]]
        checked = [len(call["seeds"]) for call in mine if not call["training"]]
        assert (cost.sim_epochs, cost.check_episodes) == (sum(trained), sum(checked)), path
        assert cost.train_iterations == len(trained) and set(trained) <= {NPG.batch_size}
    totals = sum(c.sim_epochs + c.check_episodes for c in transfer.costs.values())
    assert totals == toy.episodes > 0
    last = {r["path"]: r for r in records(transfer)}
    for path, cost in transfer.costs.items():
        assert all(last[path][key] == getattr(cost, key) for key in ("sim_epochs", "check_episodes", "train_iterations"))


def test_seeds_of_training_checking_and_evaluation_never_meet(finished):
    _, toy = finished
    trained = {seed for call in toy.of(training=True) for seed in call["seeds"]}
    checked = {seed for call in toy.of(training=False) for seed in call["seeds"]}
    assert trained and max(trained) < TRAINING_SEEDS <= CHECKING_SEEDS <= min(checked)
    assert max(checked) < CHECKING_SEEDS + 100 < EVALUATION_SEEDS
    counts = sum(len(call["seeds"]) for call in toy.of(training=True))
    assert len(trained) > 0.99 * counts, f"{counts} training episodes share {len(trained)} seeds"


def test_every_robot_is_checked_on_the_same_seeds(finished):
    """All but what was trained to the goal of a target, which has to show it on others."""
    _, toy = finished
    first = {tuple(range(CHECKING_SEEDS, CHECKING_SEEDS + 8)), tuple(range(CHECKING_SEEDS + 8, CHECKING_SEEDS + 12))}
    batches = toy.of(training=False)
    assert first <= {tuple(call["seeds"]) for call in batches}
    assert all(len(np.unique(call["alphas"], axis=0)) == 1 for call in batches)
    anew = [call for call in batches if tuple(call["seeds"]) not in first]
    assert all(min(call["seeds"]) >= CHECKING_SEEDS + 12 for call in anew)
    assert all(any(np.allclose(alpha, target.alpha) for target in TARGETS) for call in anew for alpha in call["alphas"])


def test_training_robots_lie_on_the_segment_within_the_window(finished):
    """Shares in (1 - window, 1] of the way from the robot to the next one; the window closes by 0.995 per update."""
    transfer, toy = finished
    phase, updates, drawn = None, 0, []
    for call in toy.of(training=True):
        end = call["next"] if call["next"] is not None else call["alpha"]
        here = (call["path"], call["alpha"].tobytes(), None if call["next"] is None else call["next"].tobytes())
        updates = updates + 1 if here == phase else 0
        phase = here
        assert call["window"] == pytest.approx(0.995**updates, rel=1e-12), f"update {updates} of a phase"
        shares, off = share_on_segment(call["alphas"], call["alpha"], end)
        assert off < 1e-12, f"a training robot lies {off:.1e} beside the segment"
        assert (shares >= 1 - call["window"] - 1e-9).all() and (shares <= 1 + 1e-9).all()
        drawn += list((1 - shares) / call["window"]) if call["next"] is not None else []
    assert updates >= 0 and len(drawn) > 100
    assert abs(np.mean(drawn) - 0.5) < 0.1 and np.ptp(drawn) > 0.9, "robots are not drawn evenly from the window"
    windows = [r["window"] for r in records(transfer, "update")]
    assert all(0.0 < w < 1.0 for w in windows), "the window written down is the one after the update"


# -- failure -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hopeless(tmp_path_factory):
    """(transfer, toy) of a robot that always fails."""
    toy = Toy(succeeds=False)
    settings = config(path_budget=48, xi=0.2)
    transfer = transfer_of(tmp_path_factory.mktemp("hopeless") / "run", settings, toy)
    transfer.meta_evolve()
    return transfer, toy


def test_a_hopeless_robot_exhausts_the_budget_and_says_so(hopeless):
    transfer, toy = hopeless
    budgets = records(transfer, "budget")
    assert {r["path"] for r in budgets} == set(transfer.costs), "every path has its own budget, and says when it is spent"
    assert all(cost.sim_epochs == 48 for cost in transfer.costs.values()), transfer.costs
    assert len(toy.of(training=True)) == 3 * 48 // NPG.batch_size


def test_a_hopeless_robot_never_claims_success(hopeless):
    transfer, _ = hopeless
    for record in records(transfer):
        assert not record.get("held") and not record.get("success") and not record.get("train_success"), record


def test_moves_on_a_spent_budget_do_not_say_trained(hopeless):
    transfer, _ = hopeless
    log = records(transfer)
    after = [r for before, r in zip(log, log[1:], strict=False) if before["event"] == "budget" and r["event"] == "moved"]
    assert after and not any(r["trained"] for r in after), f"{len(after)} moves on a spent budget say trained"


def test_failure_leaves_the_policy_alone(hopeless):
    """No reward, no signal: nothing but the value function may change."""
    transfer, _ = hopeless
    for policy in transfer.arrived.values():
        np.testing.assert_array_equal(policy.parameters, expert()[0].parameters)


# -- targets that lie on one another's way -------------------------------------------------------------------


def ends(folder, targets):
    """Run with a policy that holds everywhere; what arrived when it ended, or after 80 records."""

    def enough(entry, branch):
        if len(records(transfer)) >= 80:
            raise Killed

    transfer = transfer_of(folder, config(), easy_toy(), targets=targets, report=enough)
    try:
        transfer.meta_evolve()
    except Killed:
        events = [r["event"] for r in records(transfer)]
        counts = {event: events.count(event) for event in sorted(set(events))}
        pytest.fail(f"no end after {counts}, {len(transfer.costs)} paths; arrived: {list(transfer.arrived)}")
    return set(transfer.arrived)


def test_a_target_on_the_way_to_another_is_reached(tmp_path):
    near, far = Terminal("near", np.array([0.4, 0.4, 0.0])), Terminal("far", np.array([0.8, 0.8, 0.4]))
    assert ends(tmp_path / "run", [near, far]) == {"near", "far"}


def test_two_targets_at_one_place_are_both_reached(tmp_path):
    twins = [Terminal(name, np.array([0.4, 0.4, 0.0])) for name in ("one", "other")]
    assert ends(tmp_path / "run", twins) == {"one", "other"}


def test_a_target_at_the_source_is_reached(tmp_path):
    assert ends(tmp_path / "run", [Terminal("same", SOURCE.alpha), TARGETS[0]]) == {"same", "left"}


# -- killed and resumed --------------------------------------------------------------------------------------


def timeless(transfer):
    return [{k: v for k, v in record.items() if k not in TIMING} for record in records(transfer)]


def assert_same_end(transfer, unbroken):
    assert timeless(transfer) == timeless(unbroken), "metrics.jsonl differs"
    for name, policy in unbroken.arrived.items():
        np.testing.assert_array_equal(transfer.arrived[name].parameters, policy.parameters, err_msg=name)
        for field in ("shift", "scale"):
            np.testing.assert_array_equal(getattr(transfer.arrived[name].layers(), field), getattr(policy.layers(), field))
    assert transfer.costs == unbroken.costs and transfer.routes == unbroken.routes
    assert set(transfer.arrived) == set(unbroken.arrived)


RESUMED = config(native=True, check_every=2)


def natives(**settings):
    return {"left": Toy(shift=0.2, **settings), "right": Toy(shift=-0.2, **settings)}


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


# -- in any order, and side by side ----------------------------------------------------------------------------

THREE = [*TARGETS, Terminal("far", np.array([0.9, 0.1, 0.95]))]
"""Two of them part once more behind the first meta robot."""
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


def test_every_path_has_random_numbers_of_its_own():
    """By its name and the seed alone; NumPy pads what it is seeded with by zeros, which must not make a path its rival's twin."""
    names = ["path 1", "path 1.0", "path 1.1", "path 1.1.0", "path 1.2", "path 1.11", "path 1.1.1"]
    drawn = {(seed, name): path_generator(seed, name).integers(2**62) for seed in (0, 1) for name in names}
    assert len(set(drawn.values())) == len(drawn)
    assert path_generator(1, "path 1.1").integers(2**62) == drawn[1, "path 1.1"]


@pytest.mark.parametrize("kind", ["steiner", "independent"])
def test_the_drawn_tree_names_the_paths_of_the_transfer(tmp_path, kind):
    """Fixed steps do not look ahead, so that no target leaves the tree before its turn."""
    transfer = transfer_of(tmp_path / "run", config(kind=kind, step="fixed", xi=0.5), easy_toy(), targets=THREE)
    transfer.meta_evolve()
    plan, told = Plan(evolution_tree(SOURCE, THREE, kind=kind).to_json()), dict.fromkeys(record["path"] for record in records(transfer))
    assert plan.paths == [path for path in transfer.costs if path in told]


# -- the search ----------------------------------------------------------------------------------------------

SEARCH = config(learner="search", native=True, path_budget=3_000)


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    """(transfer, engine, native robots, policies that played each training batch) of a whole run of the search."""
    toy, others, played = Toy(), natives(), []

    def on_batch(branch, episodes, noise, policies):
        if max(episode.seed for episode in episodes) < TRAINING_SEEDS:
            played.append((branch.policy.copy(), policies, episodes, noise))

    transfer = transfer_of(tmp_path_factory.mktemp("search") / "run", SEARCH, toy, native=others, on_batch=on_batch)
    transfer.meta_evolve()
    return transfer, toy, others, played


def test_the_search_reaches_every_target_by_what_the_policy_sees(searched):
    """The native robots want something else again; weights are touched only where the search has had its turn."""
    transfer, _, _, _ = searched
    for target, shift in zip(TARGETS, (0.2, -0.2), strict=True):
        error = abs(float(transfer.arrived[target.name].mean(OBSERVATION)[0]) - wanted(target.alpha) - shift)
        assert error < TOLERANCE, f"{target.name} is off by {error:.2f}"
    updates = records(transfer, "update")
    assert {r["learner"] for r in updates} == {"search"} and not records(transfer, "budget")
    for policy in transfer.arrived.values():
        np.testing.assert_array_equal(policy.parameters, seeing_expert()[0].parameters)
        assert abs(float(policy.layers().shift[0]) - float(seeing_expert()[0].layers().shift[0])) > TOLERANCE


def test_the_searchs_episodes_are_counted_to_the_last(searched):
    transfer, toy, others, played = searched
    calls = [*toy.calls, *itertools.chain(*(other.calls for other in others.values()))]
    for path, cost in transfer.costs.items():
        mine = [call for call in calls if call["path"] == path]
        assert cost.sim_epochs == sum(len(call["seeds"]) for call in mine if call["training"]), path
        assert cost.check_episodes == sum(len(call["seeds"]) for call in mine if not call["training"]), path
    total = sum(cost.sim_epochs for cost in transfer.costs.values())
    assert total == sum(len(episodes) for _, _, episodes, _ in played) > 0
    learned = [r for r in records(transfer, "update") if r["learned"]]
    assert sum(cost.train_iterations for cost in transfer.costs.values()) == len(learned) > 0


def test_an_offset_is_held_for_an_episode_and_mirrored_on_the_same_start(searched):
    """No noise on the actions; each pair of policies is the branch's, moved by as much to either side, and plays one seed."""
    _, toy, _, played = searched
    assert not any(call["noisy"] for call in toy.calls)
    for policy, policies, episodes, noise in played:
        assert not noise and [e.seed for e in episodes[0::2]] == [e.seed for e in episodes[1::2]]
        offsets = np.array([p.layers().shift - policy.layers().shift for p in policies])
        np.testing.assert_allclose(offsets[0::2], -offsets[1::2], rtol=0, atol=1e-12)
        assert (np.abs(offsets) > 0).all()
        for own, episode in zip(policies, episodes, strict=True):
            np.testing.assert_array_equal(episode.actions[0], own.mean(OBSERVATION))


def test_a_first_batch_without_success_ends_after_its_first_part_and_the_step_is_halved(searched):
    transfer, toy, _, _ = searched
    short = [call for call in toy.of(training=True) if len(call["seeds"]) == 8]
    assert short, "no batch was cut"
    barren = [r for r in records(transfer, "update") if not r["learned"]]
    assert barren and all(r["train_success"] == 0 for r in barren)
    asked = [call for call in toy.of(training=True) if call["stage"] == "evolve"]
    for before, after in itertools.pairwise(asked):
        if (before["path"], before["alpha"].tobytes()) == (after["path"], after["alpha"].tobytes()):
            ahead = [float(np.linalg.norm(call["next"] - call["alpha"])) for call in (before, after)]
            assert ahead[1] == pytest.approx(ahead[0]) or ahead[1] == pytest.approx(ahead[0] / 2), ahead


def test_the_search_trains_on_the_next_robot_alone(searched):
    _, toy, _, _ = searched
    for call in toy.of(training=True):
        assert len(np.unique(call["alphas"], axis=0)) == 1 and np.array_equal(call["alphas"][0], call["next"])


def test_the_weights_have_their_turn_where_the_search_brings_no_more(tmp_path):
    """A policy that does not look: no offset moves it, so the weights have to, and take it all the way."""
    settings = config(learner="search", patience=2, search=SearchConfig(batch_size=8), path_budget=5_000)
    transfer = transfer_of(tmp_path / "run", settings, Toy(), targets=TARGETS[:1])
    blind = expert()[0].parameters.copy()
    blind[:8], blind[-2] = 0.0, wanted(SOURCE.alpha)
    blind[8:16] = 0.0
    transfer.pending[0].policy.set_parameters(blind)
    transfer.meta_evolve()
    turns = [r["learner"] for r in records(transfer, "update")]
    assert turns[0] == "search" and set(turns) == {"search", "npg"} and not records(transfer, "budget")
    assert error_at(transfer.arrived["left"], TARGETS[0].alpha) < TOLERANCE


def test_responses_have_a_turn_between_offsets_and_weights(tmp_path):
    """The same policy, but its action may respond: no offset moves it, and NPG is not needed."""
    settings = config(learner="search", patience=2, search=SearchConfig(batch_size=8, features=1), path_budget=5_000)
    toy = Toy()
    transfer = transfer_of(tmp_path / "run", settings, toy, targets=TARGETS[:1], explored=Explored(np.array([0.2]), np.array([0.2])))
    blind = expert()[0].parameters.copy()
    blind[:16], blind[-2] = 0.0, wanted(SOURCE.alpha)
    transfer.pending[0].policy.set_parameters(blind)
    transfer.meta_evolve()
    updates = records(transfer, "update")
    assert {r["turn"] for r in updates} == {"offset", "response"} and not records(transfer, "budget")
    (cost,) = transfer.costs.values()
    assert cost.check_episodes == sum(len(call["seeds"]) for call in toy.of(training=False))
    watched = cost.check_episodes - sum(r["checked"] for r in records(transfer) if r["event"] in ("check", "look", "explore"))
    assert watched > 0 and watched % 8 == 0, "the states that responses are to are seen in checks"
    assert error_at(transfer.arrived["left"], TARGETS[0].alpha) < TOLERANCE


def test_gains_have_a_turn_after_offsets(tmp_path):
    """What the policy does has to become larger or smaller: no offset does that, where it sees nothing."""
    settings = config(learner="search", patience=6, search=SearchConfig(batch_size=8, features=1), path_budget=5_000)
    explored = Explored(np.array([0.2]), np.zeros(1), (Gain("action", slice(0, 1), 1.0),))
    transfer = transfer_of(tmp_path / "run", settings, Toy(), targets=TARGETS[:1], explored=explored)
    assert transfer.training.search.turns == ("offset", "gain", "weights")
    blind = expert()[0].parameters.copy()
    blind[:16], blind[-2] = 0.0, wanted(SOURCE.alpha)
    transfer.pending[0].policy.set_parameters(blind)
    transfer.meta_evolve()
    assert {r.get("turn") for r in records(transfer, "update")} == {"offset", "gain"}
    assert error_at(transfer.arrived["left"], TARGETS[0].alpha) < TOLERANCE


def test_the_best_policy_of_a_phase_is_returned_to(tmp_path):
    """After `patience` measurements without a better one the policy is the one that was measured best, bit for bit."""
    transfer = transfer_of(tmp_path / "run", config(learner="search", patience=2), Toy())
    (branch,) = transfer.pending
    branch.begin_phase(np.full(3, 0.03))
    first = branch.policy.copy()
    assert transfer.training.keep_best(branch, 0.4) == "training"
    for success in (0.3, 0.2):
        branch.policy.set_parameters(branch.policy.parameters + 0.01)
        outcome = transfer.training.keep_best(branch, success)
    assert outcome == "training" and branch.turn == "weights", "the search's turn is over"
    np.testing.assert_array_equal(branch.policy.parameters, first.parameters)
    assert transfer.training.keep_best(branch, 0.5) == "training" and branch.best_success == 0.5 and branch.idle == 0


@pytest.mark.parametrize("best, turn", [(0.4, None), (0.6, "weights")])
def test_the_weights_have_a_turn_before_a_nearer_robot_where_they_can_learn(tmp_path, best, turn):
    transfer = transfer_of(tmp_path / "run", config(learner="search", patience=1), Toy())
    (branch,) = transfer.pending
    branch.begin_phase(np.full(3, 0.3))
    transfer.training.keep_best(branch, best)
    assert transfer.training.keep_best(branch, 0.1) == ("stalled" if turn is None else "training")
    assert turn is None or branch.turn == turn
    assert transfer.training.keep_best(branch, 0.1) == "stalled", "after both turns a nearer robot is tried"


def test_a_spent_budget_leaves_the_best_policy(tmp_path):
    """What arrives is what was measured best on its target, not what came last."""
    measured = []

    def watch(entry, branch):
        if isinstance(entry.event, Checked) and branch.next_alpha is None:
            measured.append((entry.event.success, branch.policy.copy()))

    settings = config(learner="search", kind="direct", path_budget=400, patience=50, goal=1.0, search=SearchConfig(batch_size=8, reuse=8))
    toy = Toy()
    toy.one = lambda actor, alpha, seed: Toy.one(toy, actor, alpha + (seed % 5 == 0), seed)  # so the goal is out of reach
    transfer = transfer_of(tmp_path / "run", settings, toy, targets=[Terminal("near", np.array([0.2, 0.1, 0.0]))], report=watch)
    transfer.meta_evolve()
    assert records(transfer, "budget") and len({success for success, _ in measured}) > 2
    best = max(success for success, _ in measured)
    assert any(success == best and np.array_equal(policy.layers().shift, transfer.arrived["near"].layers().shift)
               for success, policy in measured)


@pytest.mark.parametrize(
    "anew, outcome, turn", [(0.25, "training", "offset"), (0.5, "training", "weights"), (0.875, "kept", None), (1.0, "kept", None)]
)
def test_a_target_is_left_with_its_best_policy_only_if_other_starts_say_so(tmp_path, anew, outcome, turn):
    """The best of many measurements on the same starts is partly luck: what it does on others takes its place."""
    settings = config(learner="search", patience=1, goal_episodes=8, goal=0.9, enough=0.8)
    toy = Toy()
    toy.one = lambda actor, alpha, seed: Toy.one(toy, actor, alpha + (seed % 8 >= 8 * anew), seed)
    transfer = transfer_of(tmp_path / "run", settings, toy)
    (branch,) = transfer.pending
    transfer.training.keep_best(branch, 0.85)
    outcomes = [transfer.training.keep_best(branch, 0.1) for _ in range(2)]
    assert outcomes == ["training", "over"], "both turns have brought no more"
    branch.updates = 5
    success = transfer.training.measure_anew(branch, transfer.players.engine, SOURCE.alpha, 0.9, 8)
    assert transfer.training.leave(branch, success) == outcome
    assert success == branch.best_success == anew and turn in (None, branch.turn)
    seeds = [seed for call in toy.of(training=False) for seed in call["seeds"]]
    assert seeds == [2 * 10**6 + 5 * 8 + i for i in range(8)], "none of the starts by which it was chosen"
    assert bool(records(transfer, "kept")) == (outcome == "kept")


@pytest.mark.parametrize("learner", ["npg", "search"])
@pytest.mark.parametrize("lucky", [False, True])
def test_a_policy_trained_to_the_goal_has_to_show_it_on_other_starts(tmp_path, learner, lucky):
    """One that succeeds on the starts of the schedule's checks alone is trained on until the budget is spent."""
    first = set(range(2 * 10**6, 2 * 10**6 + 8))
    toy = Toy()
    toy.one = lambda actor, alpha, seed: Toy.one(toy, actor, alpha + (lucky and 10**6 <= seed < 3 * 10**6 and seed not in first), seed)
    settings = config(learner=learner, kind="direct", path_budget=400, goal_episodes=8)
    transfer = transfer_of(tmp_path / "run", settings, toy, targets=[Terminal("near", np.array([0.2, 0.1, 0.0]))])
    transfer.meta_evolve()
    assert bool(records(transfer, "budget")) == lucky
    assert any(r["success"] >= settings.goal for r in records(transfer, "check")), "the checks alone would have been believed"


def test_what_was_chosen_by_starts_is_not_left_by_the_same_starts(tmp_path):
    """Where a policy fails anew and the turns end in the same update, the best one shows what it can do on starts of a second choice."""
    checks = range(2 * 10**6, 2 * 10**6 + 8)
    toy = Toy()
    toy.one = lambda actor, alpha, seed: Toy.one(toy, actor, alpha + (seed not in checks), seed)
    transfer = transfer_of(tmp_path / "run", config(learner="search", patience=1, goal_episodes=8), toy)
    (branch,) = transfer.pending
    branch.updates, branch.turn, branch.turns, branch.best, branch.best_success = 4, "weights", 1, branch.policy.copy(), 0.5
    transfer.training.train_to(branch, transfer.players.engine, SOURCE.alpha, 0.9, 8)
    chosen, anew, left = (call["seeds"] for call in toy.of(training=False))
    assert branch.best_success == 0.0, "it was measured anew, and left with that"
    assert chosen == list(checks) and anew == [2 * 10**6 + 4 * 8 + i for i in range(8)]
    assert len(left) == 8 and not set(left) & {*chosen, *anew} and min(left) >= TRAINING_SEEDS


@pytest.mark.parametrize("share", [0.0, 0.1, 0.4, 0.75, 0.98])
def test_a_search_killed_in_a_rollout_and_resumed_is_the_same_run(tmp_path, searched, share):
    whole, toy, _, _ = searched
    kill = int(share * len(toy.calls))
    with pytest.raises(Killed):
        transfer_of(tmp_path / "run", SEARCH, Toy(kill_after=kill), native=natives()).meta_evolve()
    resumed = transfer_of(tmp_path / "run", SEARCH, Toy(), resume=True, native=natives())
    resumed.meta_evolve()
    assert_same_end(resumed, whole)


@pytest.mark.parametrize("settings", [SEARCH, config(learner="search", patience=1, search=SearchConfig(batch_size=8), path_budget=200)])
def test_a_search_killed_again_and_again_is_the_same_run(tmp_path, settings):
    """With little patience the turns and the best policy of a phase matter at every kill."""
    whole = transfer_of(tmp_path / "whole", settings, Toy(), native=natives())
    whole.meta_evolve()
    sittings = 0
    while True:
        transfer = transfer_of(tmp_path / "run", settings, Toy(kill_after=12), resume=sittings > 0, native=natives())
        try:
            transfer.meta_evolve()
            break
        except Killed:
            sittings += 1
            assert sittings < 400, "the run does not get anywhere"
    assert sittings > 3
    assert_same_end(transfer, whole)


@pytest.mark.parametrize("learner", ["npg", "search"])
def test_a_target_on_the_others_way_is_learned_once_for_all(tmp_path, learner):
    """The branch that gets there trains to the goal before it parts; the target's own has nothing left to learn."""
    near, far = Terminal("near", np.array([0.3, 0.0, 0.0])), Terminal("far", np.array([0.6, 0.0, 0.0]))
    toy = Toy()
    transfer = transfer_of(tmp_path / "run", config(learner=learner, goal=1.0, threshold=0.5), toy, targets=[near, far])
    transfer.meta_evolve()
    paths = {transfer.routes[path][-1]: path for path in transfer.costs}
    assert transfer.costs["path 1"].sim_epochs > 0 and transfer.costs[paths["near"]].sim_epochs == 0
    last = [r for r in records(transfer, "check") if r["path"] == "path 1"][-1]
    assert last["success"] == 1.0, "more than it takes to go on"
    (split,) = [r for r in records(transfer, "split") if r["path"] == paths["far"]]
    assert split["sim_epochs"] == 0
    assert error_at(transfer.arrived["near"], near.alpha) < TOLERANCE and error_at(transfer.arrived["far"], far.alpha) < TOLERANCE


def test_a_target_that_holds_already_leaves_the_tree_at_once(tmp_path):
    """Its branch begins on it, and costs no training; the others go on from where the policy stood."""
    toy = Toy()
    near = Terminal("near", np.array([0.3, 0.0, 0.43]))  # wants what the source wants
    transfer = transfer_of(tmp_path / "run", config(learner="search"), toy, targets=[TARGETS[0], near])
    transfer.meta_evolve()
    paths = {transfer.routes[path][-1]: path for path in transfer.costs}
    assert transfer.costs[paths["near"]].sim_epochs == 0 and transfer.costs["path 1"].sim_epochs == 0
    (moved,) = [r for r in records(transfer, "moved") if r["path"] == paths["near"]]
    assert not moved["trained"] and moved["distance"] == 0
    begins = [call["alpha"] for call in toy.calls if call["path"] == paths["left"]]
    np.testing.assert_array_equal(begins[0], SOURCE.alpha)
    assert error_at(transfer.arrived["left"], TARGETS[0].alpha) < TOLERANCE


def test_a_look_at_the_unmodified_robot_can_end_a_path_at_once(tmp_path):
    """F(beta) wants something else than the source; the native robot does not, and is looked at first."""
    native = Toy()
    native.one = lambda actor, alpha, seed: Toy.one(native, actor, SOURCE.alpha, seed)
    toy = Toy()
    transfer = transfer_of(tmp_path / "run", config(learner="search", native=True), toy, targets=TARGETS[:1], native={"left": native})
    transfer.meta_evolve()
    assert not toy.calls and {call["stage"] for call in native.calls} == {"settle"} and not native.of(training=True)
    assert [r["event"] for r in records(transfer)] == ["look", "moved", "check", "arrived"]


# ---- a tree that asks ------------------------------------------------------------------------------------------------


class Carrying(Toy):
    """A toy in which what holds on the right target holds on nearly all of the way from there to the left one."""

    def one(self, actor, alpha, seed):
        right, left = TARGETS[1].alpha, TARGETS[0].alpha
        share = float((alpha - right) @ (left - right) / ((left - right) @ (left - right)))
        near = np.linalg.norm(alpha - (right + share * (left - right))) < 1e-9
        return super().one(actor, right if near and 0.0 <= share <= 0.8 else alpha, seed)


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    """A finished run of a tree that asks."""
    settings = config(learner="search", kind="asking", allowance=10_000)
    transfer = transfer_of(tmp_path_factory.mktemp("asked") / "run", settings, Carrying())
    transfer.meta_evolve()
    return transfer


def test_a_target_is_left_for_from_where_a_policy_holds_nearest_to_it(asked):
    assert set(asked.arrived) == {"left", "right"}
    assert asked.routes["path 1.1"] == ["hand", "meta", "right", "left"]
    (left,) = records(asked, "left")
    assert (left["origin"], left["target"], left["share"]) == ("right", "left", 0.75)
    between = TARGETS[1].alpha + 0.75 * (TARGETS[0].alpha - TARGETS[1].alpha)
    first = next(r for r in records(asked, "moved") if r["path"] == "path 1.1")
    assert first["distance"] == pytest.approx(np.linalg.norm(TARGETS[0].alpha - between)) and not first["trained"]


def test_asking_costs_looks_and_no_training(asked):
    """All that is played beside the looks is counted as without asking: every episode is in one of the two counts."""
    costs = asked.costs.values()
    assert sum(cost.sim_epochs + cost.check_episodes for cost in costs) == asked.players.engine.episodes
    trained = sum(len(call["seeds"]) for call in asked.players.engine.of(True))
    assert sum(cost.sim_epochs for cost in costs) == trained


def test_where_no_other_policy_holds_the_tree_is_followed(tmp_path):
    class Lonely(Toy):
        def one(self, actor, alpha, seed):
            found = super().one(actor, alpha, seed)
            off_tree = min(alpha[1], TARGETS[0].alpha[1]) > META[1] + 1e-9 and alpha[2] > META[2] + 1e-9
            return dataclasses.replace(found, success=found.success and not off_tree)

    transfer = transfer_of(tmp_path / "run", config(learner="search", kind="asking", allowance=10_000), Lonely())
    transfer.meta_evolve()
    assert transfer.routes["path 1.1"] == ["hand", "meta", "left"] and not records(transfer, "left")


class Trap(Toy):
    """A toy that lets nobody through on the tree's way to the left target; the one from the source passes by."""

    def one(self, actor, alpha, seed):
        trapped = np.linalg.norm(alpha[:2] - META[:2]) < 0.5 and alpha[2] > 0.55 * alpha[0] + 0.15 and alpha[2] < 0.8
        found = super().one(actor, alpha, seed)
        return dataclasses.replace(found, success=found.success and not trapped)


RACED = config(learner="search", kind="asking", allowance=16)


@pytest.fixture(scope="module")
def raced(tmp_path_factory):
    """A finished run of a tree that asks, in which two paths raced."""
    transfer = transfer_of(tmp_path_factory.mktemp("raced") / "run", RACED, Trap())
    transfer.meta_evolve()
    return transfer


def test_a_path_that_costs_much_is_raced_from_the_source(raced):
    """One of the two arrives, the other is given up; all of both is counted."""
    rivals = [r for r in records(raced, "split") if "rival" in r]
    gone = {r["path"] for r in records(raced, "overtaken")}
    assert set(raced.arrived) == {"left", "right"} and rivals and not raced.pending
    for record in rivals:
        assert len({record["path"], record["rival"]} & gone) == 1, "one of the two is given up"
        assert raced.routes[record["path"]][0] == "hand"
    assert sum(cost.sim_epochs + cost.check_episodes for cost in raced.costs.values()) == raced.players.engine.episodes


def test_branches_take_turns_by_what_they_promise(tmp_path):
    transfer = transfer_of(tmp_path / "run", config(learner="search", kind="asking"), Toy())
    race, pending = transfer.race, transfer.pending
    slow, quick = transfer.way.part(pending[-1], [frozenset(["left"]), frozenset(["right"])])
    pending[:] = [quick, slow]
    race.asking.raced = ["left", "right"]
    for branch, gone, spent in ((slow, 0.1, 70), (quick, 0.5, 70)):
        race.begin(branch)
        branch.alpha = gone * transfer.way.goal(branch)
        branch.ledger.cost.sim_epochs = spent
    assert race.may_change(slow)
    race.choose(pending)
    assert pending[-1] is quick and quick.allowance == 140
    quick.ledger.cost.sim_epochs = 100
    assert not race.may_change(quick)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_a_tree_that_asks_killed_and_resumed_is_the_same_run(tmp_path, raced, share):
    with pytest.raises(Killed):
        transfer_of(tmp_path / "run", RACED, Trap(int(share * len(raced.players.engine.calls)))).meta_evolve()
    again = transfer_of(tmp_path / "run", RACED, Trap(), resume=True)
    again.meta_evolve()
    assert_same_end(again, raced)


class Valley(Toy):
    """Robots between a tenth and nine tenths of the way to the target want something else than both ends do."""

    def one(self, actor, alpha, seed):
        inside = 0.1 < float(alpha @ TARGETS[0].alpha / (TARGETS[0].alpha @ TARGETS[0].alpha)) < 0.9
        return super().one(actor, np.array([0.5, 0.0, 0.0]) if inside else SOURCE.alpha, seed)


@pytest.mark.parametrize("learner", ["npg", "search"])
def test_success_need_not_be_monotone_along_a_way(tmp_path, learner):
    """A policy that is already behind the robots that it could not master goes on from there, however short its last step was."""
    toy = Valley()
    transfer = transfer_of(tmp_path / "run", config(learner=learner, path_budget=500), toy, targets=TARGETS[:1])
    transfer.pending[0].stride = 0.05
    transfer.meta_evolve()
    assert not toy.of(training=True), f"{len(toy.of(training=True))} batches were trained on a way that needs none"
    assert error_at(transfer.arrived["left"], SOURCE.alpha) < TOLERANCE


class Cliff(Toy):
    """Robots up to nine tenths of the way want what no policy does; from there on the source's action succeeds for some of the seeds."""

    def one(self, actor, alpha, seed):
        ahead = 0.01 < float(alpha @ TARGETS[0].alpha / (TARGETS[0].alpha @ TARGETS[0].alpha)) < 0.9
        return super().one(actor, np.array([9.0 if ahead else 0.11, 0.0, 0.0]), seed)


def test_the_search_trains_where_a_look_succeeded_sometimes(tmp_path):
    """The end of the way is within reach although nothing before it is: not one episode is spent there."""
    toy = Cliff()
    transfer = transfer_of(tmp_path / "run", config(learner="search"), toy, targets=TARGETS[:1])
    transfer.meta_evolve()
    assert toy.of(training=True)
    for call in toy.of(training=True):
        np.testing.assert_allclose(call["alphas"], np.tile(TARGETS[0].alpha, (len(call["seeds"]), 1)), atol=1e-12)
    assert set(transfer.arrived) == {"left"} and not records(transfer, "budget")


def test_a_phase_without_success_gives_way_to_the_next_hope_then_to_half_the_way_then_to_another_look(tmp_path):
    transfer = transfer_of(tmp_path / "run", config(learner="search"), Toy())
    (branch,) = transfer.pending
    branch.hopes, branch.looked = [0.5 * META], True
    branch.begin_phase(META)
    seen = []
    while branch.next_alpha is not None:
        seen.append(float(np.linalg.norm(branch.next_alpha) / np.linalg.norm(META)))
        assert branch.looked
        transfer.stride.try_nearer(branch)
    shortest = transfer.config.xi / np.linalg.norm(META)
    assert seen[:3] == pytest.approx([1.0, 0.5, 0.25]) and shortest <= seen[-1] < 2 * shortest
    assert not branch.looked, "the policy has changed since it looked"


def test_a_search_needs_something_to_explore(tmp_path):
    with pytest.raises(ToolkitError, match="declare one in the task"):
        Transfer(config(learner="search"), SOURCE, TARGETS, *expert(), Toy(), {}, Run.create(tmp_path / "run", {}))


def test_the_search_goes_with_adaptive_steps():
    with pytest.raises(ToolkitError, match="give learner 'npg' for fixed ones"):
        TransferConfig(learner="search", step="fixed")


# -- refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "field, value",
    [("threshold", 0.0), ("threshold", 1.2), ("goal", 0.0), ("goal", 85), ("shrink", 0.0), ("shrink", 1.5), ("xi", 0.0),
     ("xi", -0.1), ("xi", math.nan), ("threshold", math.nan)],
)
def test_shares_and_lengths_are_checked(field, value):
    with pytest.raises(ToolkitError, match=rf"{field} is {value}; give a number in"):
        TransferConfig(**{field: value})


@pytest.mark.parametrize(
    "field, value",
    [("check_episodes", 0), ("goal_episodes", 0), ("check_every", 0), ("path_budget", -1), ("step", "leap"), ("seed", -1),
     ("kind", "star"), ("metric", "l3"), ("path", "winding"), ("pull", 0.0), ("pull", math.nan), ("jacobian_episodes", 1)],
)
def test_the_rest_is_checked_in_the_constructor_too(field, value):
    with pytest.raises(ToolkitError, match=field):
        TransferConfig(**{field: value})


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


def test_metrics_are_strict_json(finished):
    transfer, _ = finished
    text = (transfer.run.path / "metrics.jsonl").read_text()
    assert "NaN" not in text and "Infinity" not in text
    events = {json.loads(line)["event"] for line in text.splitlines()}
    assert events - {"look"} == {"check", "explore", "moved", "update", "split", "arrived"}
    assert ("look" in events) is (transfer.config.step == "adaptive"), "a phase of adaptive steps begins with looks"
