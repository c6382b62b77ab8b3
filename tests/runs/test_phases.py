"""What a phase leaves behind is enough to play its episodes again, bit by bit."""

import json
import struct

import numpy as np
import pytest
from damaged_files import tensors_with

from tasks import TASKS
from toolkit.errors import ToolkitError
from toolkit.expert.shelf import load_expert
from toolkit.learning.episode import Episode
from toolkit.learning.exploration import Directions, Explored
from toolkit.runs.phases import FOLDER, ROLES, KeptEpisode, Phase, PhaseRecorder, landmarks, load_phase, load_phases, score

D = 4
MISS = TASKS["061_foam_brick"].miss


@pytest.fixture(scope="module")
def policy():
    return load_expert("adroit", TASKS["061_foam_brick"])[0]


def episode(seed, success=False, steps=5, distance=0.1, diverged=False):
    last = np.zeros(38)
    last[-3:] = distance / np.sqrt(3)
    rewards = np.zeros(steps)
    rewards[-1] = success
    return Episode(np.zeros((steps, 38)), np.zeros((steps, 28)), rewards, success, diverged, True, last, np.full(D, 0.5), seed)


def mark(played):
    return score(played, MISS)


def record(recorder, policy, episodes, update=0, noise=False):
    recorder.record("path 1", "evolve", ["a"], np.zeros(D), [policy] * len(episodes), episodes, noise, update)


def test_the_episodes_worth_seeing_are_picked(tmp_path, policy):
    recorder = PhaseRecorder(tmp_path, MISS)
    record(recorder, policy, [episode(0, True, 9), episode(1, False, distance=0.3), episode(2, True, 4), episode(3, False, distance=0.6)])
    record(recorder, policy, [episode(4, True, 6)])
    (phase,) = load_phases(tmp_path).values()
    seeds = {role: phase.episode(role).seed for role in ROLES}
    assert seeds == {"first": 0, "last": 4, "best": 2, "worst": 3, "failure": 1}
    assert len(phase.episodes) == 5 and len(phase.policies) == 1, "one policy, kept once"


def test_a_diverged_episode_is_the_worst(tmp_path):
    assert mark(episode(0, diverged=True)) == -np.inf < mark(episode(0)) < mark(episode(0, True))
    assert mark(episode(0, True, 3)) > mark(episode(0, True, 8)), "the sooner the better"
    assert mark(episode(0, distance=0.1)) > mark(episode(0, distance=0.2))


def test_policies_that_no_kept_episode_was_played_by_go(tmp_path, policy):
    recorder, learning = PhaseRecorder(tmp_path, MISS), policy.copy()
    for update in range(6):
        record(recorder, learning, [episode(update, True, 9 - update)], update, noise=True)
        learning.set_parameters(learning.parameters + 1e-3)
    (phase,) = load_phases(tmp_path).values()
    assert {kept.update for kept in phase.episodes} == {0, 5} and len(phase.policies) == 2
    assert phase.episode("last").update == 5 and phase.episode("worst").update == 0
    np.testing.assert_array_equal(phase.policy_of(phase.episode("first"), policy).parameters, policy.parameters)


def test_seeing_a_batch_again_changes_nothing(tmp_path, policy):
    """A killed run plays its last batch again when it is resumed."""
    batches = [[episode(0, True, 9), episode(1)], [episode(2, True, 4), episode(3, False, distance=0.5)]]
    straight, resumed = PhaseRecorder(tmp_path / "a", MISS), PhaseRecorder(tmp_path / "b", MISS)
    for run, recorder in ((tmp_path / "a", straight), (tmp_path / "b", resumed)):
        run.mkdir()
        for update, batch in enumerate(batches):
            record(recorder, policy, batch, update)
    again = PhaseRecorder(tmp_path / "b", MISS)
    record(again, policy, batches[1], 1)
    phases = [load_phases(tmp_path / run)["path-1-000-evolve"] for run in "ab"]
    assert len({tuple(phase.episode(role).seed for role in ROLES) for phase in phases}) == 1


def test_a_mirrored_pair_is_two_episodes_and_each_keeps_its_policy(tmp_path, policy):
    """A search plays one start with two policies; seen again after a kill, both are the episodes that they were."""
    offset = np.full(38, 0.01)
    directions = Directions(Explored(np.ones(38), np.zeros(1)), np.zeros((0, policy.hidden[-1] + 1)))
    pair = [directions.moved(policy, offset), directions.moved(policy, -offset)]
    for recorder in (PhaseRecorder(tmp_path, MISS), PhaseRecorder(tmp_path, MISS)):
        recorder.record("path 1", "evolve", ["a"], np.zeros(D), pair, [episode(7, True, 9), episode(7)], False, 0)
    (phase,) = load_phases(tmp_path).values()
    assert len(phase.episodes) == len(phase.policies) == 2
    for kept, played in zip((phase.episode("best"), phase.episode("failure")), pair, strict=True):
        assert kept.seed == 7
        np.testing.assert_array_equal(phase.policy_of(kept, policy).layers().shift, played.layers().shift)


def test_phases_count_on_where_each_path_was(tmp_path, policy):
    recorder = PhaseRecorder(tmp_path, MISS, {"path 1": 2})
    record(recorder, policy, [episode(0)])
    ended = recorder.end("path 1", "evolve", ["a"], np.zeros(D), np.ones(D))
    assert ended.name == "path-1-002-evolve" and load_phases(tmp_path)["path-1-002-evolve"].end.tolist() == [1.0] * D
    assert recorder.phase("path 1", "settle", ["a"], np.ones(D)).name == "path-1-003-settle"


@pytest.mark.parametrize("damage", [lambda data: data[:40], lambda data: b"", lambda data: b"\0" * 100 + data])
def test_a_damaged_phase_is_named(tmp_path, policy, damage):
    Phase("path 1", 0, "evolve", ["a"], np.zeros(D)).save(tmp_path)
    file = tmp_path / FOLDER / "path-1-000-evolve.safetensors"
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(ToolkitError, match="truncated or not a phase"):
        load_phase(file)


@pytest.mark.parametrize("change", [
    {"takes": "x"}, {"takes": [1]}, {"number": "0"}, {"targets": "ab"}, {"path": "../../elsewhere"}, {"stage": 3}, {"more": 1},
    {"takes": [{"policy": 10**9}]}, {"takes": [{"policy": -1}]}, {"takes": [{"roles": ["king"]}]}, {"takes": [{"roles": []}]},
    {"takes": [{"score": None}]}, {"takes": [{"noise": "yes"}]},
])
def test_a_phase_that_says_what_cannot_be(tmp_path, change):
    """Opened, one of these asked for a billion policies, another would have been written outside the run folder."""
    network = {"parameters": np.zeros(4), "shift": np.zeros(2), "scale": np.ones(2)}
    kept = KeptEpisode(0, False, True, False, 9, 1.1, 0, 0, np.zeros(3), ["last"])
    phase = Phase("path 1", 0, "evolve", ["a"], np.zeros(3), None, [network], [kept])
    phase.save(tmp_path)
    file = tmp_path / "phases" / f"{phase.name}.safetensors"
    content = file.read_bytes()
    size = struct.unpack("<Q", content[:8])[0]
    header = json.loads(content[8 : 8 + size])
    state = json.loads(header["__metadata__"]["state"])
    takes = change.get("takes")
    if isinstance(takes, list) and isinstance(takes[0], dict):
        state["takes"][0] |= takes[0]
    else:
        state |= change
    header["__metadata__"]["state"] = json.dumps(state)
    tensors_with(file, header, content[8 + size :])
    with pytest.raises(ToolkitError, match="not a phase|damaged"):
        load_phase(file)


def test_landmarks_are_of_the_whole_path():
    def phase(path, number, episodes):
        return Phase(path, number, "evolve", ["t"], np.zeros(1), None, [], episodes)

    def one_kept(seed, score, *roles):
        return KeptEpisode(seed, False, score > 0, False, 9, score, 0, 0, np.zeros(1), list(roles))

    one = phase("path 1", 0, [one_kept(1, -0.2, "first", "failure", "worst"), one_kept(2, 1.1, "best", "last")])
    two = phase("path 1", 1, [one_kept(3, -0.9, "first", "worst", "failure"), one_kept(4, 1.5, "best"), one_kept(5, 1.2, "last")])
    three = phase("path 2", 0, [one_kept(6, 1.0, "first", "best", "worst", "last")])
    kept = landmarks([(each, t) for each in (one, two, three) for t in each.episodes])
    assert [t.seed for _, t in kept] == [1, 3, 4, 5, 6], "first and first failure, worst, best, last; of the other path its only one"
