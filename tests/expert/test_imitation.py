"""An expert from recorded steps: it plays what was shown, gets better by reward, and a killed training goes on to the same result."""

import json
from dataclasses import replace
from pathlib import Path

import gymnasium
import gymnasium_robotics
import numpy as np
import pytest
from toys import HAND_ROBOTS, LIFT

from robots import MODEL_ROBOTS
from tasks.hand_suite import CARDS
from toolkit.cli import main
from toolkit.demonstrations.recorded import Recorded, save_recorded
from toolkit.errors import ToolkitError
from toolkit.expert.shelf import load_expert
from toolkit.expert.training import ExpertConfig, imitate
from toolkit.learning.cloning import CloningConfig
from toolkit.learning.npg import NpgConfig
from toolkit.learning.policy import MeanActor
from toolkit.runs.run import Run
from toolkit.simulation.rollout import NativeEngine

CONFIG = ExpertConfig(
    demonstrations=6, updates=2, imitation=CloningConfig(epochs=60, init_log_std=-1.5), npg=NpgConfig(step_size=0.01, batch_size=4)
)


@pytest.fixture(scope="module")
def lifting():
    engine = NativeEngine(HAND_ROBOTS[0], LIFT, threads=1)
    yield engine
    engine.close()


@pytest.fixture(scope="module")
def recorded(lifting):
    """What a hand did that turns its finger to and fro, by its angle alone, and lifts."""
    def act(observation, rng):
        return np.array([np.sin(5 * observation[7]) + 0.3, 1.0, -1.0])

    played = lifting.play(act, [np.zeros(1)] * 8, list(range(8)))
    return Recorded(np.concatenate([e.observations for e in played]), np.concatenate([e.actions for e in played]),
                    np.array([len(e.actions) for e in played]))


def apart(policy, recorded):
    return np.sqrt(np.mean((policy.mean(recorded.observations) - recorded.actions) ** 2))


def test_what_was_shown_is_learned(lifting, recorded):
    events = []
    policy, _, card = imitate(lifting, replace(CONFIG, updates=0), recorded, events.append)
    assert apart(policy, recorded) < 0.05, f"{apart(policy, recorded):.3f} from the actions that were shown"
    assert card["demonstrations_kept"] == 6 and card["steps"] == recorded.lengths[:6].sum()
    assert [event["event"] for event in events][:2] == ["demonstrations", "cloning"]
    played = lifting.play(MeanActor(policy), [np.zeros(1)] * 3, [50, 51, 52])
    shown = LIFT.hold_steps <= LIFT.horizon and recorded.lengths[0] < LIFT.horizon
    assert all(episode.success for episode in played) or not shown


def test_only_the_first_episodes_teach(lifting, recorded):
    spoilt = Recorded(recorded.observations, recorded.actions.copy(), recorded.lengths)
    spoilt.actions[recorded.lengths[:6].sum() :] = 9.0
    one, other = (imitate(lifting, replace(CONFIG, updates=0), shown)[0] for shown in (recorded, spoilt))
    np.testing.assert_array_equal(one.parameters, other.parameters)


def test_a_killed_training_goes_on_to_the_same_result(lifting, recorded, tmp_path):
    whole, value, card = imitate(lifting, CONFIG, recorded, run=Run.create(tmp_path / "whole", {}))

    class Killed(Exception):
        pass

    for moment in ("demonstrations", "update"):
        def stop(record, moment=moment):
            if record["event"] == moment:
                raise Killed

        with pytest.raises(Killed):
            imitate(lifting, CONFIG, recorded, stop, Run.create(tmp_path / moment, {}))
        again, critic, said = imitate(lifting, CONFIG, recorded, run=Run.open(tmp_path / moment, {}))
        np.testing.assert_array_equal(again.parameters, whole.parameters)
        np.testing.assert_array_equal(critic.parameters, value.parameters)
        assert said == card


# -- the command ---------------------------------------------------------------------------------------------


HAND = ("--source", "adroit-free")


def refusal(capsys, *words):
    with pytest.raises(SystemExit) as stop:
        main(["expert", *words])
    said = capsys.readouterr().err.strip()
    assert stop.value.code == 2 and said.startswith("meta-evolve: ") and "\n" not in said
    return said


def test_bad_demonstrations_leave_no_run_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert "task door has no script that could teach; give --demos" in refusal(capsys, *HAND, "--task", "door")
    (tmp_path / "x.npz").write_bytes(b"PK\x03\x04nothing")
    assert "x.npz: expected a whole .npz file" in refusal(capsys, *HAND, "--task", "door", "--demos", "x.npz")
    assert "none.npz cannot be read" in refusal(capsys, *HAND, "--task", "door", "--demos", "none.npz")
    assert "robot 'adroit-free' cannot play task '061_foam_brick'" in refusal(capsys, *HAND, "--task", "061_foam_brick")
    assert not (tmp_path / "logs").exists()


def test_an_arm_cannot_open_the_door(capsys):
    said = refusal(capsys, "--source", "adroit", "--task", "door")
    assert "robot 'adroit' cannot play task 'door', which is for robots of the family adroit-free" in said


@pytest.mark.slow
def test_the_command_trains_from_a_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    task, rng = CARDS["door"], np.random.default_rng(0)
    shown = Recorded(rng.standard_normal((20, 39)), rng.uniform(-1, 1, (20, 28)), np.array([10, 10]))
    save_recorded(Path("door.npz"), task, shown)
    main(["expert", *HAND, "--task", "door", "--demos", "door.npz", "--updates", "1", "--episodes", "1", "--out", "out", "--json"])
    card = json.loads(capsys.readouterr().out)
    assert card["demonstrations_kept"] == 2 and card["steps"] == 20 and card["evaluation"]["successes"] == 0
    assert "--demos door.npz" in card["command"]
    assert {file.name for file in Path("out").iterdir()} == {
        "adroit-free-door.json", "adroit-free-door.policy.safetensors", "adroit-free-door.value.safetensors"}


def test_a_file_of_another_task_is_refused_before_anything_is_learned(tmp_path):
    task = CARDS["relocate"]
    save_recorded(tmp_path / "x.npz", task, Recorded(np.zeros((2, 39)), np.zeros((2, 30)), np.array([2])))
    from toolkit.demonstrations.reading import read_demonstrations

    with pytest.raises(ToolkitError, match="was recorded in another task than door"):
        read_demonstrations(tmp_path / "x.npz", CARDS["door"])


# -- what comes with the package -----------------------------------------------------------------------------

IDS = {"door": "AdroitHandDoorSparse-v1", "hammer": "AdroitHandHammerSparse-v1", "relocate": "AdroitHandRelocateSparse-v1"}


@pytest.mark.parametrize("name", IDS)
def test_a_shipped_expert_succeeds_in_gymnasium_robotics_own_environment(name):
    """As registered, from its own starts, judged by its own word; and the engine plays the same episodes."""
    task = CARDS[name]
    policy, _ = load_expert("adroit-free", task)
    engine = NativeEngine(MODEL_ROBOTS["adroit-free"], task, threads=1)
    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make(IDS[name])
    succeeded = []
    for seed in range(4):
        seen, _ = env.reset(seed=seed)
        judge, done, ended = task.judge(), False, False
        actions = []
        while not done and not ended:
            actions.append(policy.mean(seen))
            seen, _, _, ended, said = env.step(actions[-1])
            done = judge.tell(bool(said["success"]))
        succeeded.append(done)
        (episode,) = engine.play(MeanActor(policy), [np.zeros(1)], [seed])
        assert episode.success == done and len(episode.actions) == len(actions)
        np.testing.assert_allclose(episode.actions, actions, atol=1e-9)
    engine.close()
    assert sum(succeeded) >= 3, f"{sum(succeeded)} of 4 in {IDS[name]}"


def test_a_shipped_expert_is_evaluated_on_the_hand_that_can_become_others(capsys):
    for native in ([], ["--native"]):
        main(["evaluate", "adroit-free-door", *native, "--episodes", "2", "--json"])
        said = json.loads(capsys.readouterr().out)
        assert (said["target"], said["env"], said["successes"]) == ("adroit-free", "native" if native else "merged", 2)
