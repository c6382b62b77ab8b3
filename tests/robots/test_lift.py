"""robosuite's own Lift, lifted by every commercial arm with its own gripper: the stack of versions holds a cube.

With MuJoCo 3.8 and later robosuite's Robotiq 2F-85 lets go, and nothing else in the tests would say that it is the versions.
"""

import numpy as np
import pytest
import robosuite as suite
from robosuite.utils.placement_samplers import UniformRandomSampler

from robots import ROBOTS

APPROACH, DESCEND, CLOSE, RISE = 0.06, 40, 18, 35
"""Height [m] above the cube, and policy steps of each stage; closing lasts longer where the gripper closes slowly."""
ARMS = sorted({(r.arm, r.gripper.robosuite_type, r.gripper.rate) for r in ROBOTS.values() if r.gripper.rate is not None})


def square_on():
    """The cube in the middle of the table, its sides along the jaws."""
    return UniformRandomSampler(
        name="sampler", x_range=(0.0, 0.0), y_range=(0.0, 0.0), rotation=0.0, ensure_object_boundary_in_range=False,
        ensure_valid_placement=False, reference_pos=(0, 0, 0.8), z_offset=0.01,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("arm", "gripper", "rate"), ARMS, ids=[f"{arm}-{gripper}" for arm, gripper, _ in ARMS])
def test_the_cube_is_lifted(arm, gripper, rate):
    """robosuite draws the cube's sides from NumPy's global generator: seeded, as once in many runs the Jaco was handed one that it left."""
    np.random.seed(0)
    env = suite.make(
        "Lift", robots=arm, gripper_types=gripper, horizon=1000, has_renderer=False, has_offscreen_renderer=False,
        use_camera_obs=False, ignore_done=True, initialization_noise=None, placement_initializer=square_on(),
    )
    try:
        observed = env.reset()
        start = float(observed["cube_pos"][2])

        def stage(offset, closing, steps):
            """Servo the grasp frame to the cube's first place plus an offset [m]."""
            nonlocal observed
            for _ in range(steps):
                error = cube + offset - observed["robot0_eef_pos"]
                action = np.concatenate([np.clip(4.0 * error / 0.05, -1, 1), np.zeros(3), [closing]])
                observed, *_ = env.step(action)

        cube = np.array(observed["cube_pos"])
        stage(np.array([0, 0, APPROACH]), -1.0, DESCEND)
        stage(np.zeros(3), -1.0, DESCEND)
        stage(np.zeros(3), 1.0, max(CLOSE, int(2.5 / rate)))
        stage(np.array([0, 0, 0.12]), 1.0, RISE)
        raised = float(observed["cube_pos"][2]) - start
        assert env._check_success() and raised > 0.06, f"{arm} with {gripper}: the cube was raised by {100 * raised:.1f} cm"
    finally:
        env.close()
