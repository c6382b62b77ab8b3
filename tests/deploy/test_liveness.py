"""Signs of life, one at a time: what a dead arm or camera shows, and what a living one may."""

import numpy as np

from toolkit.deploy.liveness import ArmLiveness, ObjectLiveness


def lived(rows, travel, seed=None):
    """What ArmLiveness says, tick by tick, of joints that are the first coordinates of the grasp frame."""
    alive, said = ArmLiveness(), []
    for row in rows:
        place = np.append(row, 0.0) if len(row) == 5 else row
        said.append(alive.check(place[:4], place)[0])
        alive.sent(np.array([travel, 0, 0, 0, 0, 0]))
    return said


def along(steps):
    return [np.array([x, 0, 0, 0, 0, 0]) for x in np.cumsum([0.0, *steps])]


def test_an_arm_that_follows_late_is_alive():
    for delay in (0, 1, 2):
        assert not any(lived(along([1e-6] * delay + [0.01] * 20), 0.01)[delay + 1 :])


def test_an_arm_at_rest_may_repeat_itself_for_ever():
    assert not any(lived([np.zeros(6)] * 200, 0.0))


def test_a_repeated_state_is_dead_once_it_should_have_moved():
    assert lived([np.zeros(6)] * 4, 0.01) == ["", *["frozen_state"] * 3]
    slow = lived([np.zeros(6)] * 6, 0.0005)
    assert slow == ["", "", "", "frozen_state", "frozen_state", "frozen_state"], "slower than 1 cm/s, by count"


def test_an_arm_that_goes_the_other_way_is_not_obeying():
    assert "implausible_motion" in lived(along([-0.01] * 10), 0.01)


def test_the_signs_of_life_of_a_camera():
    rng, grasp = np.random.default_rng(0), np.array([0, 0, 1.0])
    turn = np.array([1.0, 0, 0, 0])
    noisy = [np.append([0, 0, 0.8] + rng.normal(0, 1e-3, 3), turn) for _ in range(8)]
    camera = ObjectLiveness()
    said = [camera.check(pose, grasp, False)[0] for pose in [*noisy, noisy[-1], noisy[-1], noisy[-1], noisy[0]]]
    assert said == [""] * 9 + ["object_frozen", "object_frozen", ""], "held while it is dead, and let go when it lives"
    quiet = ObjectLiveness()
    assert not any(quiet.check(noisy[0], grasp, False)[0] for _ in range(100)), "without noise, at rest, nobody can tell"
    slow = ObjectLiveness()
    assert not any(slow.check(noisy[i // 3], grasp, False)[0] for i in range(20)), "7 Hz is slow, not dead"
    turned = ObjectLiveness()
    turned.check(noisy[0], grasp, False)
    assert turned.check(np.append(noisy[0][:3], [0, 0, 0, 1.0]), grasp, False)[0] == "implausible"
    assert ObjectLiveness().check(-noisy[0], grasp, False) == ("", "") and turned.check(np.append(noisy[0][:3], -turn), grasp, False)[0]


def test_a_quaternion_and_its_opposite_are_one():
    pose, camera = np.array([0, 0, 0.8, 1.0, 0, 0, 0]), ObjectLiveness()
    camera.check(pose, np.zeros(3), False)
    assert camera.check(np.append(pose[:3], -pose[3:]), np.zeros(3), False) == ("", "")
