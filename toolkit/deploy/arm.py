"""What the runtime and an arm say to each other: State, Command, ArmInfo, Driver. SI units; quaternions w first."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from toolkit.bundle.manifest import Manifest
from toolkit.errors import ToolkitError

Form = Literal["osc", "pose", "joint"]
FORMS: tuple[Form, ...] = ("osc", "pose", "joint")
NEWS = 0.005
"""Change of the opening, 0 to 1, from which a gripper of a slow line is told."""
Scene = Callable[[], tuple[np.ndarray, np.ndarray, np.ndarray, float]]
"""Where the object and the goal are: position (3,) [m], quaternion (4,), goal (3,) [m], task frame, and the stamp [s]."""
Grip = Callable[[float, float], None]
"""Move the gripper to an opening, 0 closed to 1 open, which is so many metres."""


@dataclass(frozen=True, eq=False)
class State:
    """What an arm and the cameras report at one instant.

    Attributes:
        stamp: when it was measured [s], on the clock that the runtime is given (time.monotonic by default).
        joints: (n,) [rad], in the order of the driver's ArmInfo; of a joint without limits in whatever turn the arm counts.
        fingers: (m,) [rad] likewise; None: only ``opening`` is known, and the manifest's table tells the angles.
        opening: 0 closed to 1 open; None if the gripper does not report it.
        object_position: (3,) [m], object_quaternion: (4,), goal: (3,) [m], all in the task frame.
        speeds: (n,) [rad/s], efforts: (n,) [N m]; None if the arm does not report them.
        fault: what the arm itself complains of; empty if nothing.
        outcome: "running", "success" or "lost" where the arm's side judges the task, as a simulation does; else empty.
    """

    stamp: float
    joints: np.ndarray
    object_position: np.ndarray
    object_quaternion: np.ndarray
    goal: np.ndarray
    fingers: np.ndarray | None = None
    opening: float | None = None
    speeds: np.ndarray | None = None
    efforts: np.ndarray | None = None
    fault: str = ""
    outcome: str = ""


@dataclass(frozen=True, eq=False)
class Command:
    """What an arm is asked to do until the next tick.

    Attributes:
        form: what ``target`` is. osc: robosuite's OSC_POSE delta action (6,), 1 = the manifest's scale, in the controller's
            base frame. pose: the grasp frame in the arm's base frame, position [m] and quaternion (7,). joint: angles (n,) [rad],
            in the order of the driver's ArmInfo; of a joint without limits in the turn that the arm reported when the episode began,
            without jumps even where its readings wrap: it goes there the shorter way.
        hold: stand still; the target is then where to stand (osc: no delta) and the rate is zero.
        target: at the end of this tick.
        rate: there, d(target)/dt: pose: linear and angular velocity (6,) [m/s, rad/s] in the base frame; joint: (n,) [rad/s];
            osc: empty.
        grip: robosuite's gripper action, -1 opens, 0 keeps, +1 closes.
        opening: the same as a target, 0 closed to 1 open.  opening_m: the same in metres between the fingers.
        waypoints: (k, n) [rad] or (k, 7) poses on the way to the target, evenly spaced in time, the last being the target;
            k = the arm's rate over the policy's. osc: (0, 0).
    """

    form: Form
    hold: bool
    target: np.ndarray
    rate: np.ndarray
    grip: float
    opening: float
    opening_m: float
    waypoints: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))


@dataclass(frozen=True)
class ArmInfo:
    """What an arm is, as its driver says on connecting.

    Attributes:
        robot: the toolkit's name of the system, compared with the bundle's.
        joints: names of the arm's joints in the order of State.joints.  fingers: likewise, of State.fingers.
        forms: commands that it takes.
        rate_hz: at which it wants waypoints.
        angle_unit, length_unit: of State and Command; "rad" and "m" or it is refused.
        frame: of the object's pose and the goal; "task" or it is refused.
        model_sha256: of a simulated robot; empty for a real one.
    """

    robot: str
    joints: tuple[str, ...]
    fingers: tuple[str, ...]
    forms: tuple[Form, ...]
    rate_hz: float
    angle_unit: str = "rad"
    length_unit: str = "m"
    frame: str = "task"
    model_sha256: str = ""


class Clock(Protocol):
    """The time in which an arm lives: of stamps, of ticks, and of whoever sleeps."""

    def now(self) -> float:
        """[s] since whenever."""

    def sleep(self, seconds: float) -> None:
        """Return when so much time has passed."""


class WallClock:
    """This machine's, which a real arm shares."""

    def now(self) -> float:
        """See Clock."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """See Clock."""
        time.sleep(seconds)


WALL = WallClock()


class Driver(Protocol):
    """An arm. A driver keeps its own watchdog: without a command for a few periods its arm stands still."""

    def connect(self) -> ArmInfo:
        """Open the connection and say what is there."""

    def read(self) -> State:
        """The newest state, without waiting for a newer one."""

    def send(self, command: Command) -> Command:
        """Pass a command on; returns what was really sent, after the driver's own limits."""

    def stop(self, reason: str) -> None:
        """Stop the arm and give up control; may be called at any time, and twice."""


def check_fit(manifest: Manifest, info: ArmInfo, form: Form) -> None:
    """Refuse an arm that the bundle was not made for, by the name of what differs.

    Raises:
        ToolkitError: another robot, model, joint or finger, another unit or frame, or no such form of command.
    """
    robot, joints = manifest.robot.name, tuple(joint.name for joint in manifest.joints)
    if info.robot != robot:
        raise ToolkitError(f"the driver moves robot {info.robot!r}, but the bundle is for {robot!r}; give the bundle of {info.robot!r}")
    if info.model_sha256 and info.model_sha256 != manifest.robot.model_sha256:
        raise ToolkitError(
            f"robot {robot!r} is not the model that the bundle was made on (digest {info.model_sha256[:12]}..., not "
            f"{manifest.robot.model_sha256[:12]}...); install {_versions(manifest)}, or export the bundle again"
        )
    for kind, wanted, found in (("joint", joints, info.joints), ("finger joint", manifest.gripper.joints, info.fingers)):
        if not found and kind == "finger joint":
            continue  # an opening is enough
        odd = sorted(set(wanted) ^ set(found))
        if odd or len(found) != len(wanted):
            culprit = odd[0] if odd else next(name for name in found if found.count(name) > 1)
            whose = "the driver lacks" if culprit in wanted and culprit not in found else "the bundle lacks, or the driver repeats,"
            raise ToolkitError(f"{whose} {kind} {culprit!r}; the bundle has {', '.join(wanted)}")
    for what, reported, taken in (("angles", info.angle_unit, "rad"), ("lengths", info.length_unit, "m"), ("frame", info.frame, "task")):
        if reported != taken:
            raise ToolkitError(f"the driver of {robot!r} reports {what} in {reported!r}, the bundle takes {taken!r}; convert in the driver")
    if form not in info.forms:
        raise ToolkitError(f"the driver of {robot!r} takes no {form!r} commands; it takes: {', '.join(info.forms)}")
    if info.rate_hz < manifest.policy_hz:
        raise ToolkitError(f"the driver of {robot!r} runs at {info.rate_hz} Hz, slower than the policy's {manifest.policy_hz} Hz")


def _versions(manifest: Manifest) -> str:
    return " and ".join(f"{name} {version}" for name, version in manifest.versions.items() if name in ("robosuite", "mujoco"))
