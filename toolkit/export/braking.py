"""How far an arm still goes when it is held in motion: the twin, moved and held in every form of command."""

from dataclasses import replace

import numpy as np

from robots.robot import Robot
from tasks.pick import PickTask
from toolkit.bundle.manifest import Braking, BrakingDistance, Manifest
from toolkit.bundle.onnx_graph import ActionMap
from toolkit.deploy.arm import FORMS, Command, Form
from toolkit.deploy.kinematics import Kinematics
from toolkit.deploy.motion import motion_of
from toolkit.export.datasheet import Played
from toolkit.export.twin import Twin

STOPPED_FROM, MOVED_FOR, STOPPED_FOR = (0.25, 0.5, 1.0), 8, 16
"""Actions from which the arm is held, policy steps that it moves before, and that it is watched after."""
DIRECTIONS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1))
"""In which it moves: not down, where the object and the table are."""
AT_REST = 1e-4
"""[m] per policy step below which an arm stands."""
FAR = 100.0
"""[m, rad] at which the workspace's borders do not slow a motion that is only measured."""


def measure_braking(robot: Robot, task: PickTask, manifest: Manifest, mjcf: str, played: np.ndarray) -> tuple[BrakingDistance, ...]:
    """Form by form, slowest first: the arm moves at a constant action from its start, and is held; the worst of five directions.

    Args:
        robot, task: what is simulated, without load.
        manifest: whose limits of speed and acceleration hold; those of place do not.
        mjcf: robot.xml.
        played: (T, n) arm angles of the golden episode [rad].
    """
    twin, far = Twin(robot, task, "lockstep"), (FAR,) * 6
    free = replace(manifest, cartesian=replace(manifest.cartesian, low=tuple(-f for f in far), high=far, table_clearance_m=-FAR))
    return tuple(_brake(twin, form, action, free, mjcf, played) for form in FORMS for action in STOPPED_FROM)


def _brake(twin: Twin, form: Form, action: float, manifest: Manifest, mjcf: str, played: np.ndarray) -> BrakingDistance:
    speeds, farthest, longest = [], 0.0, 0
    for direction in DIRECTIONS:
        path = _path(twin, form, np.append(action * np.array(direction, float), [0.0, 0.0, 0.0, -1.0]), manifest, mjcf, played)
        moved = np.linalg.norm(np.diff(path, axis=0), axis=1)
        speeds.append(float(moved[MOVED_FOR - 1] * manifest.policy_hz))
        farthest = max(farthest, float(np.linalg.norm(path[MOVED_FOR:] - path[MOVED_FOR], axis=1).max()))
        still = np.flatnonzero(moved[MOVED_FOR:] >= AT_REST)
        longest = max(longest, int(still[-1]) + 1 if len(still) else 0)
    return BrakingDistance(form, max(speeds), farthest, longest / manifest.policy_hz)


def _path(twin: Twin, form: Form, action: np.ndarray, manifest: Manifest, mjcf: str, played: np.ndarray) -> np.ndarray:
    """(T, 3) [m] where the grasp frame is, period by period."""
    kinematics = Kinematics.of(manifest, mjcf)
    motion = motion_of(form, manifest, kinematics, twin.describe()["rate_hz"], mjcf, played)
    twin.begin(0)
    places = []

    def look() -> np.ndarray:
        state = twin.read()
        joints = np.array(state["joints"])
        kinematics.place(joints, np.array(state["fingers"]))
        places.append(kinematics.position)
        return joints

    motion.begin(look())
    for step in range(MOVED_FOR + STOPPED_FOR):
        command: Command = motion.advance(action, np.array(twin.read()["joints"])) if step < MOVED_FOR else motion.hold()
        twin.send(command)
        look()
    return np.array(places)


def lowest_rest(played: Played, delay: int, braking: Braking, manifest: Manifest, action_map: ActionMap) -> float:
    """Smallest height [m] above the table at which the runtime would foresee the gripper's lowest point at rest in these episodes: held
    after the action that answers a state, and braking from that state's speed, in the worst of the forms. What does not sink stays.

    Args:
        played: episodes.
        delay: policy steps after which a state is answered.
        braking: whose distances count.
        manifest, action_map: of the policy, and whose controller.
    """
    controller, lowest = manifest.controller, np.inf
    covers = controller.translation_m * controller.response.steady[2]  # upwards, which a turning first joint does not change
    for grasp, heights, actions in zip(played.grasp, played.heights, played.actions, strict=True):
        leads = covers * action_map(actions[1 + delay :])[:, 2]  # the answers to the second state and those that follow
        velocity = np.diff(grasp[: len(leads) + 1, :3], axis=0) * manifest.policy_hz
        speed = np.linalg.norm(velocity, axis=1)
        goes = np.max([np.interp(speed, *curve) for curve in braking.curves.values()], axis=0)
        falls = np.where(velocity[:, 2] < 0.0, leads + goes * velocity[:, 2] / np.maximum(speed, 1e-9), 0.0)
        lowest = min(lowest, float((heights[1 : len(leads) + 1] + np.minimum(0.0, falls)).min()))
    return lowest
