"""Grippers: ADROIT against gymnasium-robotics' own compiled model, every card against robosuite's own gripper."""

import tempfile
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import robosuite as suite
from robosuite.models.grippers import GRIPPER_MAPPING

from grippers import GRIPPERS
from grippers.adroit import ADROIT, AdroitHand, asset_path
from grippers.gripper import CLOSING_ROLES, COMMANDED_ROLES, DIGITS, ROLE_PARENT, ROLES
from robots import ROBOTS
from toolkit.morphology.native_scene import GRIPPER_PREFIX, role_actuators, role_joints
from toolkit.morphology.posture import target_at

QUIET = {"has_renderer": False, "has_offscreen_renderer": False, "use_camera_obs": False}


@pytest.fixture(scope="module")
def original():
    """ADROIT as gymnasium-robotics compiles it: joints, masses and frames by a route that shares no code with ours."""
    return mujoco.MjModel.from_xml_path(str(asset_path() / "adroit_relocate.xml"))


@pytest.fixture
def hand(native):
    return native("adroit").model


# -- ADROIT --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arm", sorted({robot.arm for robot in ROBOTS.values()}))
def test_adroit_mounts_on_every_arm_of_robosuite(arm):
    env = suite.make("Lift", robots=arm, gripper_types="AdroitHand", horizon=10, **QUIET)
    try:
        env.reset()
        low, high = env.action_spec
        rng = np.random.default_rng(0)
        for _ in range(5):
            env.step(rng.uniform(low, high))
        qpos = env.sim.data.qpos
        assert np.isfinite(qpos).all(), f"{arm}: qpos is not finite after 5 steps"
        assert len(low) == 6 + 22, f"{arm}: {len(low)} action entries, 6 + 22 expected"
        warned = {mujoco.mjtWarning(i).name: w.number for i, w in enumerate(env.sim.data._data.warning) if w.number}
        assert not warned, f"{arm}: MuJoCo warned {warned}"
    finally:
        env.close()


@pytest.mark.parametrize("field", ["jnt_range", "jnt_margin", "jnt_stiffness"])
def test_adroits_joints_are_the_originals(hand, original, field):
    for role in COMMANDED_ROLES:
        mine = getattr(hand, field)[hand.joint(GRIPPER_PREFIX + role).id]
        theirs = getattr(original, field)[original.joint(role).id]
        np.testing.assert_array_equal(mine, theirs, err_msg=f"{role} {field}")


def test_the_merged_hands_digits_are_adroits_chains(original):
    """Read from the original's bodies: whose joint is above whose, and which is outermost."""
    fingers = {int(original.joint(role).id): role for role in COMMANDED_ROLES}
    above = {}
    for joint, role in fingers.items():
        body = int(original.jnt_bodyid[joint])
        while body and (body == original.jnt_bodyid[joint] or not set(range(original.njnt)[_joints(original, body)]) & set(fingers)):
            body = int(original.body_parentid[body])
        above[role] = None if not body else fingers[int(original.body_jntadr[body])]
    assert {role for role, parent in above.items() if parent is None} == {digit.joints[0] for digit in DIGITS}
    for digit in DIGITS:
        assert [above[role] for role in digit.joints[1:]] == list(digit.joints[:-1])
        assert {digit.flexion, digit.pad, digit.tip} <= set(digit.joints) and digit.tip not in above.values()
        assert not digit.slide or (ROLE_PARENT[digit.joints[0]], ROLE_PARENT[digit.slide]) == (digit.slide, None)
    assert [digit.title for digit in DIGITS if digit.opposes] == ["thumb"]


def _joints(model, body):
    return slice(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]) if model.body_jntnum[body] else slice(0, 0)


@pytest.mark.parametrize("field", ["dof_damping", "dof_armature"])
def test_adroits_joint_dynamics_are_the_originals(hand, original, field):
    for role in COMMANDED_ROLES:
        mine = getattr(hand, field)[hand.joint(GRIPPER_PREFIX + role).dofadr[0]]
        theirs = getattr(original, field)[original.joint(role).dofadr[0]]
        assert mine == theirs, f"{role} {field}: {mine}, gymnasium-robotics has {theirs}"


def test_the_friction_that_adroit_loses_is_a_hundredth_of_its_servos_at_most(hand, original):
    """The one thing left out of the joints, for speed; see grippers/adroit.py."""
    for role, actuator in role_actuators(hand, ROBOTS["adroit"]).items():
        lost = float(original.dof_frictionloss[original.joint(role).dofadr[0]])
        lost -= float(hand.dof_frictionloss[hand.joint(GRIPPER_PREFIX + role).dofadr[0]])
        servo = float(hand.actuator_gainprm[actuator, 0] * np.ptp(hand.actuator_ctrlrange[actuator]))
        assert 0 <= lost < 0.01 * servo, f"{role}: {lost} N m of friction left out, its servo gives {servo} N m"


def test_adroit_has_22_finger_joints_and_no_wrist(hand):
    joints = [hand.joint(j).name.removeprefix(GRIPPER_PREFIX) for j in range(hand.njnt)
              if hand.joint(j).name.startswith(GRIPPER_PREFIX)]
    assert len(joints) == 22, f"{len(joints)} finger joints"
    assert set(joints) == set(COMMANDED_ROLES) == set(ADROIT.joints)


def test_adroits_actuators_are_the_originals(hand, original):
    for role, actuator in role_actuators(hand, ROBOTS["adroit"]).items():
        theirs = original.actuator(f"A_{role}").id
        np.testing.assert_allclose(
            hand.actuator_gainprm[actuator, 0], original.actuator_gainprm[theirs, 0], err_msg=role
        )
        np.testing.assert_allclose(hand.actuator_ctrlrange[actuator], original.actuator_ctrlrange[theirs], err_msg=role)


def finger_bodies(original):
    """Bodies below the palm, by the original model's tree."""
    palm = original.body("palm").id
    below = {palm}
    for body in range(palm + 1, original.nbody):
        if original.body_parentid[body] in below:
            below.add(body)
    return [original.body(body).name for body in sorted(below - {palm})]


def test_adroits_links_weigh_and_turn_as_the_originals(hand, original):
    names = finger_bodies(original)
    assert len(names) == 22, f"{len(names)} links below the palm"
    for name in names:
        mine, theirs = hand.body(GRIPPER_PREFIX + name), original.body(name)
        np.testing.assert_allclose(mine.mass, theirs.mass, rtol=1e-12, err_msg=f"mass of {name}")
        np.testing.assert_allclose(mine.inertia, theirs.inertia, rtol=1e-9, err_msg=f"inertia of {name}")


def test_adroits_fingers_move_as_the_originals(hand, original):
    """Every link's place in the palm over random postures: only the wrist was welded."""
    rng = np.random.default_rng(0)
    mine, theirs = mujoco.MjData(hand), mujoco.MjData(original)
    worst = 0.0
    for _ in range(20):
        for role in COMMANDED_ROLES:
            angle = rng.uniform(*original.joint(role).range)
            mine.qpos[hand.joint(GRIPPER_PREFIX + role).qposadr[0]] = angle
            theirs.qpos[original.joint(role).qposadr[0]] = angle
        mujoco.mj_kinematics(hand, mine)
        mujoco.mj_kinematics(original, theirs)
        for name in finger_bodies(original):
            places = []
            for data, prefix in ((mine, GRIPPER_PREFIX), (theirs, "")):
                palm, link = data.body(prefix + "palm"), data.body(prefix + name)
                places.append(palm.xmat.reshape(3, 3).T @ (link.xpos - palm.xpos))
            worst = max(worst, float(np.abs(places[0] - places[1]).max()))
    assert worst < 1e-9, f"a link stands {worst:.1e} m from where gymnasium-robotics puts it in the palm"


def test_adroits_fingers_never_touch_each_other(hand):
    geoms = [g for g in range(hand.ngeom) if hand.geom(g).name.startswith(GRIPPER_PREFIX + "C_")]
    assert geoms, "no collision geoms C_*"
    clash = [(a, b) for a in geoms for b in geoms if hand.geom_contype[a] & hand.geom_conaffinity[b]]
    assert not clash, f"{len(clash)} pairs of the hand's own geoms may collide"


def test_adroit_starts_open_with_its_joints_in_the_order_of_the_roles(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    gripper = AdroitHand()
    assert gripper.joints == [gripper.naming_prefix + role for role in COMMANDED_ROLES]
    np.testing.assert_array_equal(gripper.init_qpos, [ADROIT.targets[role][0] for role in COMMANDED_ROLES])
    np.testing.assert_array_equal(gripper.format_action(np.full(22, 3.0)), np.ones(22))
    assert not list(tmp_path.iterdir()), "the temporary MJCF was left behind"


# -- cards ---------------------------------------------------------------------------------------------------


def test_roles_are_a_forest_with_parents_first():
    for index, role in enumerate(ROLES):
        parent = ROLE_PARENT[role]
        assert parent is None or ROLES.index(parent) < index, f"{role} comes before its parent {parent}"
        assert parent is None or parent[:2] == role[:2], f"{role} hangs on another finger, at {parent}"
    assert set(CLOSING_ROLES) < set(COMMANDED_ROLES)


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_targets_lie_within_the_controls_of_the_gripper(native, name):
    robot, model = ROBOTS[name], native(name).model
    for role, actuator in role_actuators(model, robot).items():
        low, high = model.actuator_ctrlrange[actuator]
        for command in (-1.0, 0.0, 1.0):
            target = target_at(robot, role, command)
            assert low - 1e-9 <= target <= high + 1e-9, f"{name} {role}: target {target} rad outside [{low}, {high}]"


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_every_joint_of_the_gripper_has_a_role_and_every_actuator_a_target(native, name):
    robot, model = ROBOTS[name], native(name).model
    joints = {j for j in range(model.njnt) if model.joint(j).name.startswith(GRIPPER_PREFIX)}
    assert set(role_joints(model, robot).values()) == joints
    actuators = {a for a in range(model.nu) if model.actuator(a).name.startswith(GRIPPER_PREFIX)}
    assert set(role_actuators(model, robot).values()) == actuators


@pytest.mark.parametrize("gripper", [g for g in GRIPPERS.values() if g.rate is not None], ids=lambda g: g.name)
def test_a_grippers_rate_is_robosuites(gripper):
    speed = GRIPPER_MAPPING[gripper.robosuite_type]().speed
    assert gripper.rate == speed, f"{gripper.name}: rate {gripper.rate}, robosuite integrates {speed}"


@pytest.mark.parametrize(
    "change, sentence",
    [
        ({"joints": {"XXJ9": "joint_index"}, "targets": {}}, r"unknown role 'XXJ9'; the roles are FFS"),
        ({"targets": {"FFJ9": (0.0, 1.0)}}, r"unknown role 'FFJ9'"),
        ({"targets": {"LFJ4": (0.0, 1.0)}}, r"role 'LFJ4' has a target but no joint"),
        ({"preshape": 1.5}, r"preshape 1.5 lies outside \[-1, 1\]"),
        ({"preshape": float("nan")}, r"preshape nan lies outside"),
        ({"rate": 0.0}, r"rate 0.0 lies outside \(0, 2\]"),
        ({"rate": -0.2}, r"rate -0.2 lies outside"),
        ({"rate": 2.5}, r"rate 2.5 lies outside"),
        ({"rate": float("nan")}, r"rate nan lies outside"),
    ],
)
def test_a_bad_card_is_refused_with_its_culprit(change, sentence):
    with pytest.raises(ValueError, match=f"gripper jaco3: {sentence}"):
        replace(GRIPPERS["jaco3"], **change)
