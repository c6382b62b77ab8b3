"""F: patched in place it is the model compiled from scratch, at a robot it is that robot, anywhere it can step."""

import time

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robots import ROBOTS
from tasks.pick import ACTION_SIZE
from toolkit.demonstrations.scripts import entry, pick_script
from toolkit.errors import ToolkitError
from toolkit.morphology.build import MergedRobot
from toolkit.morphology.matching import match
from toolkit.morphology.native_scene import GRIP_SITE, NativeScene
from toolkit.morphology.space import EvolutionSpace
from toolkit.simulation.laws import merged_plant
from toolkit.simulation.rollout import play

every_robot = pytest.mark.parametrize("name", list(ROBOTS))
OPEN = -1.0


def numbers(model):
    """Every array of a compiled model and its statistics; the static bounding volumes are compiled once, loose."""
    out = {field: getattr(model, field) for field in dir(model) if not field.startswith(("_", "bvh_"))}
    out |= {
        f"stat.{field}": getattr(model.stat, field)
        for field in ("meaninertia", "meanmass", "meansize", "extent", "center")
    }
    return {field: value for field, value in out.items() if isinstance(value, (np.ndarray, float))}


def assert_equals_scratch(merged, alpha, label):
    model, data = merged.new()
    merged.become(alpha, model, data)
    mine, scratch = numbers(model), numbers(merged.compile(alpha))
    assert len(mine) > 200, f"only {len(mine)} fields compared"
    off = {}
    for field, wanted in scratch.items():
        got = np.asarray(mine[field], float)
        error = np.abs(got - wanted) / np.maximum(1.0, np.abs(wanted))
        if error.size and not error.max() < 1e-9:
            off[field] = float(error.max())
    assert not off, f"{label}: F in place differs from a compiled model in {off}"


@pytest.fixture(scope="module")
def scratch_merged(space, task):
    """A merged robot of its own: compiling renews the addresses that the shared one patches."""
    return MergedRobot(space, task)


@every_robot
def test_f_in_place_is_f_from_scratch_at_a_robot(scratch_merged, space, name):
    assert_equals_scratch(scratch_merged, space.beta(name), name)


@pytest.mark.parametrize("seed", range(4))
def test_f_in_place_is_f_from_scratch_between_robots(scratch_merged, space, seed):
    rng = np.random.default_rng(seed)
    alpha = rng.random(space.size) if seed % 2 else rng.integers(0, 2, space.size).astype(float)
    assert_equals_scratch(scratch_merged, alpha, f"random alpha {seed}")


def test_f_forgets_what_it_was_before(merged, space):
    """Robot, robot, robot and back: the first model again, bit for bit."""
    model, data = merged.new()
    merged.become(space.beta("adroit"), model, data)
    first = {field: np.array(value) for field, value in numbers(model).items()}
    for name in (*ROBOTS, "adroit"):
        merged.become(space.beta(name), model, data)
    changed = [
        field for field, value in numbers(model).items() if not np.array_equal(first[field], value, equal_nan=True)
    ]
    assert not changed, f"{changed} remember another robot"


def test_f_leaves_the_template_and_other_copies_alone(merged, space):
    template, (model, data), (other, _) = numbers(merged.template), merged.new(), merged.new()
    before = {field: np.array(value) for field, value in template.items()}
    merged.become(space.beta("iiwa"), model, data)
    for label, untouched in (("template", merged.template), ("another copy", other)):
        changed = [f for f, value in numbers(untouched).items() if not np.array_equal(before[f], value, equal_nan=True)]
        assert not changed, f"patching one model changed {changed} of the {label}"


def test_f_is_cheap(merged, space, record_property):
    """Under 1 ms on an idle core; beside other work, no more than MuJoCo's own part of it allows for."""
    model, data = merged.new()
    took = {"become": [], "mj_setConst": []}
    for index in range(100):
        started = time.thread_time()
        merged.become(space.betas[index % len(space.betas)], model, data)
        became = time.thread_time()
        mujoco.mj_setConst(model, data)
        took["become"].append(became - started)
        took["mj_setConst"].append(time.thread_time() - became)
    median, floor = (1e3 * float(np.median(took[part])) for part in ("become", "mj_setConst"))
    record_property("milliseconds", median)
    record_property("milliseconds_of_mj_setConst", floor)
    assert median < max(1.0, 8.0 * floor), f"F(alpha) takes {median:.2f} ms, of which mj_setConst {floor:.2f} ms"


def test_an_alpha_outside_the_space_builds_nothing(merged, space):
    model, data = merged.new()
    with pytest.raises(ToolkitError, match=r"lies outside \[0, 1\]"):
        merged.become(np.full(space.size, 1.01), model, data)


# -- every alpha can be stepped ------------------------------------------------------------------------------


def stepped(merged, alpha, seed):
    """A plant after a second of random actions, and its last observation; it stops where the simulation blows up."""
    rng = np.random.default_rng(seed)
    plant = merged_plant(merged, alpha, *merged.new())
    observation = plant.begin(seed % 1000)
    for _ in range(20):
        observation = plant.step(rng.uniform(-1, 1, ACTION_SIZE))
        if plant.diverged:
            break
    return plant, observation


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1))
def test_any_alpha_steps_a_second_of_random_actions(merged, space, seed):
    plant, observation = stepped(merged, np.random.default_rng(seed).random(space.size), seed)
    warned = {mujoco.mjtWarning(i).name: w.number for i, w in enumerate(plant.data.warning) if w.number}
    speed = np.abs(plant.data.qvel).max()
    assert not warned and not plant.diverged, f"MuJoCo warned {warned}, speed {speed:.0f} rad/s, seed {seed}"
    assert plant.data.time == pytest.approx(1.0), f"a step lasts {plant.data.time / 20} s"
    assert np.isfinite(observation).all(), f"observation is not finite, seed {seed}"


def test_nearly_every_corner_steps_and_the_others_are_noticed(merged, space, log_elsewhere):
    """Corners mix robots at random, a link's mass with another's reach: a few are no bodies, and none may pass for one."""
    blown = 0
    for seed in range(40):
        plant, observation = stepped(merged, np.random.default_rng(seed).integers(0, 2, space.size).astype(float), seed)
        blown += plant.diverged
        assert plant.diverged or np.isfinite(observation).all(), f"corner {seed}: not finite, and not noticed"
    assert blown <= 8, f"{blown} of 40 corners blow up within a second"  # 6 on the machine where this was written


@pytest.mark.parametrize("value", [0.0, 1.0, 0.5])
def test_the_ends_and_the_middle_of_the_box_can_be_stepped(merged, space, value):
    plant = merged_plant(merged, np.full(space.size, value), *merged.new())
    plant.begin(0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        plant.step(rng.uniform(-1, 1, ACTION_SIZE))
    warned = {mujoco.mjtWarning(i).name: w.number for i, w in enumerate(plant.data.warning) if w.number}
    assert not warned and not plant.diverged, f"alpha = {value}: MuJoCo warned {warned}"


def test_no_link_or_geom_of_a_robot_leaves_its_bounding_box(merged, space):
    """F keeps one loose static box per hand link, so every robot's geoms must lie within it."""
    model, data = merged.new()
    rng = np.random.default_rng(0)
    for alpha in (*space.betas, *rng.random((3, space.size)), *rng.integers(0, 2, (3, space.size)).astype(float)):
        merged.become(alpha, model, data)
        for geom in range(model.ngeom):
            body = int(model.geom_bodyid[geom])
            if (
                not model.geom_contype[geom]
                or model.body_bvhnum[body] == 0
                or model.geom(geom).name in ("table", "object")
            ):
                continue
            rotation = np.empty(9)
            mujoco.mju_quat2Mat(rotation, model.body_iquat[body])
            center = rotation.reshape(3, 3).T @ (model.geom_pos[geom] - model.body_ipos[body])
            reach = float(np.abs(center).max() + model.geom_rbound[geom])
            half = float(model.bvh_aabb[model.body_bvhadr[body], 3:].min())
            assert reach < half, f"{model.geom(geom).name} reaches {reach:.3f} m from its link, the box {half} m"


# -- at a robot it is that robot -----------------------------------------------------------------------------


class Pair:
    """F(beta) beside the robot itself, with the arm at the same configuration and the fingers at their start."""

    def __init__(self, merged, robot, name):
        space = merged.space
        self.system = space.matching.systems[space.matching.names.index(name)]
        self.model, self.data = merged.new()
        merged.become(space.beta(name), self.model, self.data)
        self.native, self.native_data = robot.model, mujoco.MjData(robot.model)
        self.native_data.qpos[:] = robot.data.qpos
        own = [i for i in range(space.matching.arm_size) if self.system.present(i)]
        self.joints = [self.system.joints[i] for i in own]
        self.arm = [self.model.joint(space.matching.slots[i].name).id for i in own]
        self.native_arm = NativeScene(self.native).arm

    def pose(self, rng):
        """Both arms at one random configuration within the limits (half a turn either way without)."""
        for mine, theirs, joint in zip(self.arm, self.native_arm, self.joints, strict=True):
            low, high = self.native.jnt_range[theirs] if self.native.jnt_limited[theirs] else (-np.pi, np.pi)
            angle = rng.uniform(low, high)
            self.native_data.qpos[self.native.jnt_qposadr[theirs]] = angle
            self.data.qpos[self.model.jnt_qposadr[mine]] = joint.sign * (angle - joint.start)
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_forward(self.native, self.native_data)

    def arm_mass_matrices(self):
        out = []
        for model, data, joints in (
            (self.model, self.data, self.arm),
            (self.native, self.native_data, self.native_arm),
        ):
            full, dofs = np.empty((model.nv, model.nv)), model.jnt_dofadr[joints]
            mujoco.mj_fullM(model, full, data.qM)
            out.append(full[np.ix_(dofs, dofs)])
        sign = np.array([joint.sign for joint in self.joints])
        return sign[:, None] * out[0] * sign, out[1]


@pytest.fixture
def pair(merged, native, name):
    return Pair(merged, native(name), name)


@every_robot
def test_the_merged_arm_has_the_robots_forward_kinematics(pair, name):
    rng = np.random.default_rng(2)
    shift = turn = 0.0
    for _ in range(50):
        pair.pose(rng)
        mine, theirs = pair.data.site("grasp"), pair.native_data.site(GRIP_SITE)
        shift = max(shift, float(np.linalg.norm(mine.xpos - theirs.xpos)))
        turn = max(turn, float(np.abs(mine.xmat - theirs.xmat).max()))
    assert shift < 1e-6, f"{name}: grasp frame {shift:.1e} m from the robot's own"
    assert turn < 1e-6, f"{name}: grasp frame turned {turn:.1e} rad from the robot's own"


@every_robot
def test_the_merged_arm_has_the_robots_mass_matrix(pair, name):
    rng = np.random.default_rng(3)
    worst = 0.0
    for _ in range(50):
        pair.pose(rng)
        mine, theirs = pair.arm_mass_matrices()
        worst = max(worst, float(np.linalg.norm(mine - theirs) / np.linalg.norm(theirs)))
    assert worst < 1e-6, f"{name}: arm mass matrix {worst:.1e} from the robot's own, relatively"


@every_robot
def test_the_merged_arm_is_as_heavy_to_hold(pair, name):
    """Gravity torques of arm and gripper together."""
    rng = np.random.default_rng(4)
    sign = np.array([joint.sign for joint in pair.joints])
    worst = 0.0
    for _ in range(20):
        pair.pose(rng)
        mine = sign * pair.data.qfrc_bias[pair.model.jnt_dofadr[pair.arm]]
        theirs = pair.native_data.qfrc_bias[pair.native.jnt_dofadr[pair.native_arm]]
        worst = max(worst, float(np.abs(mine - theirs).max() / np.abs(theirs).max()))
    assert worst < 1e-6, f"{name}: gravity torques {worst:.1e} from the robot's own, relatively"


def farthest_apart(merged, fast, name, seed):
    """Largest distance [m] of the grasp frames of F(beta) and of the robot itself in 1 s of the same commands."""
    rng = np.random.default_rng(seed)
    plant = merged_plant(merged, merged.space.beta(name), *merged.new())
    if fast.model.opt.density == 0:
        plant.model.opt.density = plant.model.opt.viscosity = 0.0
    fast.begin(seed)
    plant.begin(seed)
    worst = 0.0
    for _ in range(20):
        action = np.full(ACTION_SIZE, OPEN)
        action[:6] = np.array([0, 0, 0.4, 0, 0, 0]) + rng.uniform(-0.5, 0.5, 6)
        places = [entry(p.step(action), "grasp_position") for p in (fast, plant)]
        worst = max(worst, float(np.linalg.norm(places[0] - places[1])))
    return worst


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        pytest.param(name, seed, marks=pytest.mark.xfail(reason="1.1 mm: three wide bodies on one link, two boxes for them"))
        if (name, seed) == ("panda", 1) else (name, seed)
        for name in ROBOTS for seed in (0, 1)
    ],
)
def test_the_merged_robot_follows_the_same_commands(merged, native_fast, name, seed, record_property):
    """In free space, gripper open."""
    worst = 1e3 * farthest_apart(merged, native_fast(name), name, seed)
    record_property("millimetres", worst)
    assert worst < 1.0, f"{name}: grasp frame {worst:.2f} mm from the unmodified robot's within 1 s"


@every_robot
def test_without_air_the_merged_robot_follows_closer_still(merged, native_fast, name):
    """Air apart, what is left is the dead weight of the four-bar grippers' knuckles."""
    fast = native_fast(name)
    options = fast.model.opt
    air = options.density, options.viscosity
    try:
        options.density = options.viscosity = 0.0
        worst = 1e3 * farthest_apart(merged, fast, name, 0)
    finally:
        options.density, options.viscosity = air
    limit = 0.2 if ROBOTS[name].arm_friction else 0.1  # a contact that holds a joint is no dry friction exactly
    assert worst < limit, f"{name}: grasp frame {worst:.4f} mm from the unmodified robot's within 1 s, without air"


@pytest.mark.parametrize("name", list(ROBOTS))
def test_frozen_joints_stay_where_they_froze(merged, space, name):
    plant = merged_plant(merged, space.beta(name), *merged.new())
    plant.begin(0)
    theta, action = space.theta(space.beta(name)), np.full(ACTION_SIZE, OPEN)
    action[:6] = 0
    for _ in range(10):
        plant.step(action)
    frozen = [
        slot.name for slot, freeze in zip(space.matching.slots, theta["freeze"][:, 0], strict=True) if freeze == 1.0
    ]
    moved = {joint: abs(float(plant.data.joint(joint).qpos[0])) for joint in frozen}
    worst = max(moved, key=moved.get, default=None)
    assert worst is None or moved[worst] < 0.005, f"{name}: frozen joint {worst} moved {moved[worst]:.4f} rad"


def test_robots_without_a_hand_among_them_merge_as_well(task):
    """Most roles are then nobody's: their joints are frozen, may stand anywhere, and leave both robots able to pick."""
    space = EvolutionSpace(match([ROBOTS["panda"], ROBOTS["iiwa"]]))
    merged = MergedRobot(space, task)
    for alpha, label in ((space.betas[0], "panda"), (space.betas.mean(axis=0), "between"), (space.betas[1], "iiwa")):
        assert_equals_scratch(merged, alpha, label)
        played = play(merged_plant(merged, alpha, *merged.new()), pick_script(task.object), 20_000_000, alpha)
        assert played.success, f"the script drops the brick on {label}"
