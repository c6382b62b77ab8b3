"""The replay: what a recorded hand did is played again in simulation, and what cannot be followed is counted and named."""

import numpy as np
import pytest

from robots import ROBOTS
from tasks import TASKS
from tasks.dexycb.standin import SERIALS
from toolkit.demonstrations.replay import Dropped, Retargeter, teachers_for
from toolkit.errors import ToolkitError


def test_a_recorded_pick_is_played_again_in_simulation(retargeter, demonstration):
    assert demonstration.succeeded, f"the replay fails after {demonstration.steps} steps"
    trace = retargeter.trace(demonstration)
    assert trace.success and len(trace.qpos) == demonstration.steps + 1
    np.testing.assert_allclose(trace.goal - trace.qpos[0, -7:-4], demonstration.scene.task.goal_offset, atol=1e-6)
    figures = demonstration.to_json()
    assert figures["replay_succeeded"] and figures["tip_error_mm"] == pytest.approx(1e3 * demonstration.motion.tip_error.mean())


def test_a_hand_that_misses_is_dropped_and_counted(root, tmp_path):
    import shutil

    wrong = tmp_path / "wrong"
    shutil.copytree(root, wrong)
    for serial in SERIALS:
        for file in wrong.glob(f"*/*/{serial}/labels_*.npz"):
            with np.load(file) as arrays:
                content = dict(arrays)
            if (content["joint_3d"] != -1).any():
                content["joint_3d"] += np.float32([0.15, 0.0, 0.0])
            np.savez(file, **content)
    with pytest.raises(ToolkitError, match="none of 1 recordings of 061_foam_brick in .* can be followed"):
        teachers_for(wrong, ROBOTS["adroit"], TASKS["061_foam_brick"])


def test_an_object_that_nobody_recorded_is_said(root):
    with pytest.raises(ToolkitError, match="no recording of 008_pudding_box; it has: 061_foam_brick"):
        teachers_for(root, ROBOTS["adroit"], TASKS["008_pudding_box"])


def test_an_empty_folder_is_said(tmp_path):
    with pytest.raises(ToolkitError, match="expected folders <subject>/<time>/meta.yml, found none"):
        Retargeter(tmp_path, ROBOTS["adroit"])


def test_a_broken_recording_stops_with_its_sentence(root, tmp_path):
    import shutil

    shutil.copytree(root, tmp_path / "broken")
    next((tmp_path / "broken").glob("*/*/pose.npz")).write_bytes(b"PK")
    retargeter = Retargeter(tmp_path / "broken", ROBOTS["adroit"])
    with pytest.raises(ToolkitError, match="pose.npz: expected a whole .npz file"):
        retargeter.read(retargeter.names[0])


def test_the_clip_is_drawn(retargeter, demonstration, tmp_path):
    from toolkit.inspection.recording.hands import Clip, record_clips

    d, trace = demonstration, retargeter.trace(demonstration)
    clip = Clip(d.recording.name, d.scene.task.object, 0.04, d.scene.joints(d.recording), d.scene.object_poses(d.recording), d.hand,
                d.motion.frames, d.motion.qpos, trace.model, trace.qpos, 0.05, "reaches the goal")
    record_clips(tmp_path / "hands.rrd", [clip, clip])
    assert (tmp_path / "hands.rrd").stat().st_size > 10**5
    assert not isinstance(d, Dropped)
