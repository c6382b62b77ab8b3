"""Door, hammer, relocate: the tasks of the Hand Manipulation Suite, as gymnasium-robotics has them.

Rajeswaran et al., "Learning Complex Dexterous Manipulation with Deep Reinforcement Learning and Demonstrations", RSS 2018; scenes, starts,
observations and goals are those of gymnasium-robotics' AdroitHandDoor, AdroitHandHammer and AdroitHandRelocate. Scenes are read from the
installed package, and nothing in them is changed: visual meshes stay, as they collide with nothing, weigh nothing (all masses are given)
and are wanted for pictures.
"""

from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from robots.model_robot import ModelRobot
from tasks.record import Entry, Record
from tasks.task import ModelTask, Scene

CONTROL_FREQUENCY = 100.0
"""Policy steps a second: SUBSTEPS of 2 ms each."""
SUBSTEPS = 5
HORIZON = 200
"""Policy steps of an episode (gymnasium-robotics, as registered; Meta-Evolve, hyperparameters)."""
HOLD_STEPS = {"door": 1, "hammer": 81, "relocate": 40}
"""Policy steps at the goal that make a success, not necessarily one after another: those by which Meta-Evolve's released code counts its
episodes (Hand Manipulation Suite with evolving robots). gymnasium-robotics only says of each step whether it is at the goal."""

FINGER_JOINTS = (
    *(f"{finger}J{k}" for finger in ("FF", "MF", "RF") for k in (3, 2, 1, 0)),
    *(f"LFJ{k}" for k in (4, 3, 2, 1, 0)),
    *(f"THJ{k}" for k in (4, 3, 2, 1, 0)),
)
HAND_JOINTS = ("WRJ1", "WRJ0", *FINGER_JOINTS)
MOUNT_JOINTS = {
    "door": ("ARTz", "ARRx", "ARRy", "ARRz"),
    "hammer": ("ARRx", "ARRy"),
    "relocate": ("ARTx", "ARTy", "ARTz", "ARRx", "ARRy", "ARRz"),
}
"""Joints of the forearm's mount: slides ART [m], hinges ARR [rad]; the robot's own, in the task's scene."""

Ranges = tuple[tuple[float, float], ...]
STARTS: dict[str, Ranges] = {
    "door": ((-0.3, -0.2), (0.25, 0.35), (0.252, 0.35)),
    "hammer": ((0.1, 0.25),),
    "relocate": ((-0.15, 0.15), (-0.15, 0.3), (-0.2, 0.2), (-0.2, 0.2), (0.15, 0.35)),
}
"""What is drawn for an episode [m], in gymnasium-robotics' order: x, y, z of the door's frame; the board's height; x, y of the ball and
x, y, z of where it shall be."""
LIGHT_STARTS: dict[str, Ranges] = STARTS | {
    "hammer": ((0.1, 0.15),),
    "relocate": ((-0.1, 0.1), (-0.1, 0.1), (-0.1, 0.1), (-0.1, 0.1), (0.15, 0.35)),
}
"""The same in Meta-Evolve's released code."""
LIGHTER = 5.0
"""By which that divides the masses of hammer and ball."""

OPEN = 1.35
"""Angle [rad] of the door from which on it counts as open."""
AJAR = 1.0
"""Angle [rad] from which on the observation says +1 instead of -1."""
NAILED = 0.01
"""Distance [m] of the nail's head from where it shall be."""
NEAR = 0.1
"""Distance [m] of the ball from where it shall be."""
LIFTED = 0.04
"""Height [m] from which on ball or hammer counts as lifted."""
PUSHED = 0.2
"""Angle [rad] of a door that has begun to open."""
NEARLY_NAILED = 0.02
"""Distance [m] of the nail's head from where it shall be, at which the nail is nearly in."""
NAIL_OUT = 0.101
"""The same of a nail that is as far out as its joint allows, at most (in the easier scene)."""
DROPPED = 0.05
"""Height [m] of a hammer that lies on the table again."""
NEARER = 0.05
"""Distance [m] of the ball from where it shall be, at which it is paid most."""
FALLEN = -0.05
"""Height [m] of a ball that has left the table, whose top is at 0: no hand reaches below."""

SPREAD = {
    "door": (
        0.16, 0.29, 0.63, 0.14, 0.3, 0.098, 0.24, 0.3, 0.33, 0.1, 0.39, 0.24, 0.29, 0.12, 0.3, 0.28, 0.33, 0.12, 0.12, 0.26,
        0.32, 0.37, 0.25, 0.27, 0.069, 0.12, 0.32, 0.77, 0.53, 0.14, 0.19, 0.063, 0.18, 0.16, 0.082, 0.12, 0.12, 0.048, 0.85,
    ),
    "hammer": (
        0.092, 0.11, 0.18, 0.23, 0.09, 0.16, 0.33, 0.36, 0.074, 0.39, 0.28, 0.37, 0.055, 0.28, 0.4, 0.46, 0.11, 0.084, 0.46,
        0.35, 0.41, 0.2, 0.26, 0.055, 0.11, 0.28, 0.014, 0.41, 0.095, 0.25, 0.59, 0.56, 0.66, 0.067, 0.012, 0.052, 0.069, 0.022,
        0.065, 0.2, 0.18, 0.26, 0.013, 0.0052, 0.042, 0.19,
    ),
    "relocate": (
        0.057, 0.0093, 0.14, 0.23, 0.21, 0.092, 0.035, 0.13, 0.12, 0.16, 0.32, 0.32, 0.051, 0.34, 0.22, 0.25, 0.048, 0.22, 0.3,
        0.34, 0.1, 0.072, 0.27, 0.43, 0.47, 0.48, 0.26, 0.047, 0.12, 0.22, 0.044, 0.089, 0.088, 0.12, 0.14, 0.11, 0.13, 0.16,
        0.12,
    ),
}
"""Standard deviation of each number of the observation over the human demonstrations of Rajeswaran et al. (hand_dapg), in its unit: the
smallest scale by which a policy normalises it."""
SHIFTED = 0.15
"""Of that: the standard deviation with which a search begins to explore the offset of each number. By such offsets alone, each tried for
whole episodes, hands half way to two fingers open doors and relocate balls as the source does."""
ANSWERED = {"mount": 0.02, "hand": 0.1}
"""Standard deviation with which a search begins to explore how each servo's target responds, in half of its control range: what a grip
bears. A policy that opens doors with four fingers from 54 % of the starts still does from 50 % where the hand's targets are shifted by 0.1
for an episode, and from 17 % where the mount's four are by 0.03."""


class _Scene(Scene):
    """What the three scenes share: the hand, by names that were looked up once.

    Args:
        model: of any hand in the task's scene.
        data: of that model.
        starts: of STARTS.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, starts: Ranges) -> None:
        self.model, self.data, self._starts = model, data, starts
        self._limited = np.flatnonzero(model.jnt_limited)
        self._addresses = model.jnt_qposadr[self._limited]
        self._palm = model.site("S_grasp").id

    def begin(self, rng: np.random.Generator) -> None:
        """Draw what the task draws, in gymnasium-robotics' order; see ``Scene.begin``.

        All joints begin at zero, as there; one whose range does not reach so far at the end of its range.
        """
        self._place(rng)
        low, high = self.model.jnt_range[self._limited].T
        self.data.qpos[self._addresses] = np.clip(self.data.qpos[self._addresses], low, high)
        mujoco.mj_forward(self.model, self.data)

    def _place(self, rng: np.random.Generator) -> None:
        raise NotImplementedError

    def lost(self) -> bool:
        """Never: a hand may yet push door and nail."""
        return False

    @staticmethod
    def stages(data: mujoco.MjData) -> float:
        """What Meta-Evolve's released code pays for a step that ends so, 0 or more, where it says sparse; see ``HandTask.staged``."""
        raise NotImplementedError


class DoorScene(_Scene):
    """A door with a latch, at a place that is drawn."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, starts: Ranges) -> None:
        super().__init__(model, data, starts)
        self._frame, self._handle = model.body("frame").id, model.site("S_handle").id
        self._hinge = model.joint("door_hinge").qposadr[0]

    def _place(self, rng: np.random.Generator) -> None:
        self.model.body_pos[self._frame] = [rng.uniform(low, high) for low, high in self._starts]

    def observe(self) -> np.ndarray:
        """The record (39,)."""
        data, out = self.data, np.empty(39)
        hinge = data.qpos[self._hinge]
        palm, handle = data.site_xpos[self._palm], data.site_xpos[self._handle]
        out[:27] = data.qpos[1:-2]
        out[27], out[28] = data.qpos[-1], hinge
        out[29:32], out[32:35], out[35:38] = palm, handle, palm - handle
        out[38] = 1.0 if hinge > AJAR else -1.0
        return out

    def at_goal(self) -> bool:
        """Whether the door is open."""
        return bool(self.data.qpos[self._hinge] >= OPEN)

    @staticmethod
    def stages(data: mujoco.MjData) -> float:
        """2 for a door that begins to open, 10 from AJAR on, 20 for one that is open."""
        angle = data.joint("door_hinge").qpos[0]
        return 2.0 * (angle > PUSHED) + 8.0 * (angle > AJAR) + 10.0 * (angle > OPEN)


class HammerScene(_Scene):
    """A hammer on the table, and a nail in a board whose height is drawn."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, starts: Ranges) -> None:
        super().__init__(model, data, starts)
        self._board, self._hammer = model.body("nail_board").id, model.body("Object").id
        self._nail, self._goal = model.site("S_target").id, model.site("nail_goal").id
        self._force = model.sensor("S_nail").adr[0]

    def _place(self, rng: np.random.Generator) -> None:
        self.model.body_pos[self._board, 2] = rng.uniform(*self._starts[0])

    def observe(self) -> np.ndarray:
        """The record (46,)."""
        data, out = self.data, np.empty(46)
        out[:27] = data.qpos[:-6]
        out[27:33] = np.clip(data.qvel[-6:], -1.0, 1.0)
        out[33:36], out[36:39] = data.site_xpos[self._palm], data.xpos[self._hammer]
        out[39:42] = _euler(data.xmat[self._hammer])
        out[42:45] = data.site_xpos[self._nail]
        out[45] = min(max(data.sensordata[self._force], -1.0), 1.0)
        return out

    def at_goal(self) -> bool:
        """Whether the nail is in."""
        return bool(np.linalg.norm(self.data.site_xpos[self._nail] - self.data.site_xpos[self._goal]) < NAILED)

    @staticmethod
    def stages(data: mujoco.MjData) -> float:
        """10 a metre of the nail's way, 2 for a lifted hammer, 25 for a nail that is nearly in, 75 more for one that is in, all but 10 of
        them lost if the hammer was dropped; nothing while the hand touches the hammer's neck.

        The released code pays -10 a metre of the way that is left and takes 120 for the touch. Here the nail's whole way is added to every
        step, and what is below 0 is 0.
        """
        if _neck_touched(data):
            return 0.0
        left = float(np.linalg.norm(data.site("S_target").xpos - data.site("nail_goal").xpos))
        hammer, tool = data.body("Object").xpos[2], data.site("tool").xpos[2]
        paid = 10.0 * (NAIL_OUT - left) + 2.0 * (min(hammer, tool) > LIFTED) + 25.0 * (left < NEARLY_NAILED)
        return max(paid + (75.0 - 90.0 * (hammer < DROPPED)) * (left < NAILED), 0.0)


class RelocateScene(_Scene):
    """A ball on the table and a place in the air, both drawn."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, starts: Ranges) -> None:
        super().__init__(model, data, starts)
        self._ball, self._target = model.body("Object").id, model.site("target").id

    def _place(self, rng: np.random.Generator) -> None:
        drawn = [rng.uniform(low, high) for low, high in self._starts]
        self.model.body_pos[self._ball, :2], self.model.site_pos[self._target] = drawn[:2], drawn[2:]

    def observe(self) -> np.ndarray:
        """The record (39,)."""
        data, out = self.data, np.empty(39)
        palm, ball, target = data.site_xpos[self._palm], data.xpos[self._ball], data.site_xpos[self._target]
        out[:30] = data.qpos[:-6]
        out[30:33], out[33:36], out[36:39] = palm - ball, palm - target, ball - target
        return out

    def at_goal(self) -> bool:
        """Whether the ball is where it shall be."""
        return bool(np.linalg.norm(self.data.xpos[self._ball] - self.data.site_xpos[self._target]) < NEAR)

    @staticmethod
    def stages(data: mujoco.MjData) -> float:
        """1 for a lifted ball, 10 for one that is where it shall be, 20 more for one that is still nearer."""
        ball = data.body("Object").xpos
        apart = float(np.linalg.norm(ball - data.site("target").xpos))
        return 1.0 * (ball[2] > LIFTED) + 10.0 * (apart < NEAR) + 20.0 * (apart < NEARER)

    def lost(self) -> bool:
        """Whether the ball has fallen off the table."""
        return bool(self.data.xpos[self._ball, 2] < FALLEN)


def _neck_touched(data: mujoco.MjData) -> bool:
    """Whether a shape of the hand that collides touches the hammer's neck."""
    model = data.model
    neck = model.geom("neck").id
    pairs = data.contact.geom
    others = pairs[(pairs == neck).any(axis=1)].sum(axis=1) - neck
    return any(model.geom(int(other)).name.startswith("C_") for other in others)


def _euler(xmat: np.ndarray) -> np.ndarray:
    """Angles (3,) [rad] of a rotation Rx Ry Rz that is given by its nine numbers, row by row; gymnasium-robotics' convention."""
    return np.array([-np.arctan2(xmat[5], xmat[8]), np.arctan2(xmat[2], np.hypot(xmat[5], xmat[8])), -np.arctan2(xmat[1], xmat[0])])


def _record(task: str, joints: tuple[str, ...], more: dict[str, Entry]) -> Record:
    """Joints and more as a record, scaled by SPREAD, offsets explored by SHIFTED of that."""
    entries = {f"joint/{name}": Entry(1, "m" if name.startswith("ART") else "rad", "joint", "position") for name in joints} | more
    spread, found = iter(SPREAD[task]), {}
    for name, entry in entries.items():
        scale = tuple(next(spread) for _ in range(entry.size))
        found[name] = replace(entry, scale=scale, explored=tuple(SHIFTED * value for value in scale))
    return Record(found)


def _place(meaning: str) -> Entry:
    return Entry(3, "m", "world", meaning)


def _lighten(spec: mujoco.MjSpec, task: str) -> None:
    """Make a scene the easier one of Meta-Evolve's released code: hard contacts without a margin, a light hammer balanced in the hand, a
    nail that slides, a light short rod in place of the ball."""
    for geom in spec.geoms:
        geom.margin, geom.solref[:2], geom.solimp = 0.0, (0.02, 1.0), (0.999, 0.9999, 0.001, 0.01, 6.0)
        if geom.name.startswith("V_"):
            geom.contype = geom.conaffinity = 0  # two boxes of 1 mm are no mere pictures
    palm = spec.geom("C_lfmetacarpal")
    palm.size, palm.pos = (0.011, 0.0111, 0.033), (-0.015, 0.0, 0.01)
    if task == "door":
        return
    body = spec.body("Object")
    body.mass, body.inertia = body.mass / LIGHTER, body.inertia / LIGHTER
    if task == "hammer":
        body.ipos = (0.0, 0.0, 0.0)
        nail = spec.joint("nail_dir")
        nail.frictionloss, nail.range = 0.5, (-0.01, 0.095)
    else:
        ball = spec.geom("sphere")
        ball.type, ball.size, ball.quat = mujoco.mjtGeom.mjGEOM_CAPSULE, (0.03, 0.02, 0.0), (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)


@dataclass(frozen=True, eq=False)
class HandTask(ModelTask):
    """A task of the suite.

    Attributes:
        kind: "door", "hammer" or "relocate".
        environment_class: of gymnasium-robotics, by its name.
        scene_class: reads and places what is in it.
        light: the easier scene of Meta-Evolve's released code, for comparison with it, named "<kind>-light".
        staged: rewarded as that code does where it says sparse, for comparison with it, named "<kind>-staged" or "<kind>-light-staged":
            every step by the stage that was reached (``stages`` of the scene), instead of 1 for the task's completion, which success
            is in either case. As success ends an episode, whose later steps that code would have paid, its step is paid for them, too.
    """

    kind: str
    observation: Record
    environment_class: str
    scene_class: type[_Scene]
    light: bool = False
    staged: bool = False
    horizon: int = HORIZON
    control_frequency: float = CONTROL_FREQUENCY
    substeps: int = SUBSTEPS

    family = "adroit-free"
    consecutive = False

    @property
    def name(self) -> str:
        """On the command line."""
        return self.kind + ("-light" if self.light else "") + ("-staged" if self.staged else "")

    @property
    def kin(self) -> tuple[str, ...]:
        """The plain task."""
        return (self.kind,)

    def reward(self, data: mujoco.MjData, succeeded: bool, left: int) -> float:
        """See Task, and ``staged``."""
        if not self.staged:
            return super().reward(data, succeeded, left)
        return float(self.scene_class.stages(data)) * (1 + left * succeeded)

    @property
    def hold_steps(self) -> int:
        """HOLD_STEPS."""
        return HOLD_STEPS[self.kind]

    @property
    def action(self) -> Record:
        """One servo's target each: -1 and +1 are the ends of its range."""
        explored = dict.fromkeys(MOUNT_JOINTS[self.kind], ANSWERED["mount"]) | dict.fromkeys(HAND_JOINTS, ANSWERED["hand"])
        return Record({
            f"servo/{name}": Entry(1, "1", "joint", "target, in its control range", explored=far) for name, far in explored.items()
        })

    def spec(self, robot: ModelRobot) -> mujoco.MjSpec:
        """The robot in the task's scene.

        Raises:
            ValueError: a robot of another family.
        """
        from grippers.adroit import asset_path

        if robot.family.name != self.family:
            raise ValueError(f"{robot.name} is of the family {robot.family.name}; {self.name} is played by {self.family}")
        spec = mujoco.MjSpec.from_file(str(asset_path() / f"adroit_{self.kind}.xml"))
        if self.light:
            _lighten(spec, self.kind)
        robot.change(spec)
        return spec

    def scene(self, model: mujoco.MjModel, data: mujoco.MjData) -> Scene:
        """The scene of a model that ``spec`` made, or of one in between."""
        return self.scene_class(model, data, (LIGHT_STARTS if self.light else STARTS)[self.kind])

    def environment(self, robot: ModelRobot) -> Any:
        """gymnasium-robotics' environment, sparsely rewarded, with this robot in it; ``step`` and what it observes are its own.

        Episodes begin as a scene's do: on the unmodified robot just as gymnasium-robotics', on others with a joint that cannot be at zero
        at the end of its range.
        """
        import farama_notifications

        farama_notifications.notifications.pop("gymnasium_robotics", None)  # printed at the import; speaks of rewards that are not used
        from gymnasium_robotics.envs import adroit_hand

        task, model = self, self.spec(robot).compile()

        base: Any = getattr(adroit_hand, self.environment_class)

        class Environment(base):
            def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
                data = mujoco.MjData(model)
                self._begun = task.scene(model, data)
                return model, data

            def reset_model(self) -> np.ndarray:
                self._begun.begin(self.np_random)
                return self._get_obs()

        return Environment(reward_type="sparse")


_KINDS = (
    (
        "door",
        _record("door", (*MOUNT_JOINTS["door"][1:], *HAND_JOINTS), {
            "latch": Entry(1, "rad", "joint", "of the handle"),
            "hinge": Entry(1, "rad", "joint", "of the door"),
            "palm": _place("of the palm"),
            "handle": _place("of the handle"),
            "palm_from_handle": _place("palm from the handle"),
            "ajar": Entry(1, "1", "", "+1 from AJAR on, else -1"),
        }),
        "AdroitHandDoorEnv", DoorScene,
    ),
    (
        "hammer",
        _record("hammer", (*MOUNT_JOINTS["hammer"], *HAND_JOINTS), {
            "nail_depth": Entry(1, "m", "joint", "of the nail"),
            "hammer_velocity": Entry(3, "m/s", "world", "of the hammer, cut to +-1"),
            "hammer_rates": Entry(3, "rad/s", "hammer", "of the hammer, cut to +-1"),
            "palm": _place("of the palm"),
            "hammer": _place("of the hammer"),
            "hammer_angles": Entry(3, "rad", "world", "of the hammer, as _euler"),
            "nail": _place("of the nail's head"),
            "nail_force": Entry(1, "N", "", "on the nail, cut to +-1"),
        }),
        "AdroitHandHammerEnv", HammerScene,
    ),
    (
        "relocate",
        _record("relocate", (*MOUNT_JOINTS["relocate"], *HAND_JOINTS), {
            "palm_from_ball": _place("palm from the ball"),
            "palm_from_target": _place("palm from where the ball shall be"),
            "ball_from_target": _place("ball from where it shall be"),
        }),
        "AdroitHandRelocateEnv", RelocateScene,
    ),
)
CARDS: dict[str, HandTask] = {
    task.name: task for light in (False, True) for staged in (False, True)
    for task in (HandTask(name, records, environment, scene, light, staged) for name, records, environment, scene in _KINDS)
}
