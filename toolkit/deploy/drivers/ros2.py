"""Any arm behind ros2_control's joint_trajectory_controller. Tested against fakes of the messages; never run on hardware, nor with a
ROS 2 installation.

    joint   a JointTrajectory of one tick to the controller's topic, each taking over from the last
    hold    a trajectory of one point, with no speed; stop: an empty trajectory, which makes the controller hold where it is

``open_arm`` makes the node, its subscriptions and a thread that spins it; ``open_arm(..., listens=True)`` makes nothing that publishes.
What belongs around it is here, too: the joints' names in ROS (``JOINT_NAMES``), the controller's YAML (``controllers_yaml``), the task
frame in tf (``static_transform``), the cameras through tf (``TfScene``), the gripper through its action (``GripperAction``) and its joint
(``JointOpening``).

ROS speaks rad and m, and its quaternions are x y z w: everything here turns them round.
"""

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from toolkit.bundle.manifest import Manifest
from toolkit.deploy.arm import NEWS, WALL, ArmInfo, Clock, Command, Grip, Scene, State
from toolkit.deploy.drivers.stamps import DeviceClock, least_fresh
from toolkit.deploy.kinematics import matrix_of, quaternion_of
from toolkit.errors import ToolkitError

RATE = 100.0
"""[Hz] of the waypoints in a trajectory."""
PERIOD = 0.05
"""[s] of a tick."""
WATCHDOG = 0.2
"""[s] after a trajectory's end at which the controller gives it up (its cmd_timeout) and holds."""
STATES, TRAJECTORY = "/joint_states", "/joint_trajectory_controller/joint_trajectory"
"""Topics, by ros2_control's usual names."""

JOINT_NAMES: dict[str, tuple[str, ...]] = {
    "iiwa": tuple(f"lbr_A{i}" for i in range(1, 8)),  # lbr_fri_ros2_stack
    "jaco": tuple(f"j2s7s300_joint_{i}" for i in range(1, 8)),  # kinova-ros, and ros2_kortex's description of it
    "kinova3": tuple(f"joint_{i}" for i in range(1, 8)),  # ros2_kortex, gen3 7dof
    "panda": tuple(f"panda_joint{i}" for i in range(1, 8)),  # franka_description; an FR3's are fr3_joint1 to 7
    "ur5e": ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", *(f"wrist_{i}_joint" for i in range(1, 4))),  # ur_description
}
"""The toolkit's name of an arm -> its joints' names in the usual ROS 2 driver, base to flange. A driver started with a prefix puts it
before them. Names say nothing of signs and zeros: compare each joint with the teach pendant."""


class Ros2:
    """An arm behind a joint_trajectory_controller.

    Args:
        publisher: of JointTrajectory messages; None: nothing is ever sent.
        trajectory, point, duration: the message classes.
        robot: the toolkit's name of the system.
        joints: names of the arm's joints in the bundle, base to flange.  ros_names: the same joints' names in ROS.
        scene: reads the cameras.
        gripper: moves the gripper.  opening: reads it, 0 closed to 1 open.
        clock: of the stamps.
    """

    def __init__(
        self, publisher: Any, trajectory: Any, point: Any, duration: Any, robot: str, joints: Sequence[str], ros_names: Sequence[str],
        scene: Scene, gripper: Grip, opening: Callable[[], float], clock: Clock = WALL,
    ) -> None:
        self.publisher, self.trajectory, self.point, self.duration = publisher, trajectory, point, duration
        self.robot, self.names, self.ros_names = robot, tuple(joints), tuple(ros_names)
        self.scene, self.gripper, self.opening, self.clock = scene, gripper, opening, clock
        self._heard: tuple[float, Any] | None = None
        self._there: set[str] = set()  # what has been a number for every joint, and is to be one from then on
        self._stopped = ""
        self._stamped = DeviceClock(self.clock.now)

    def heard(self, message: Any) -> None:
        """Callback for /joint_states, on which several may speak: a gripper's own message says nothing of the arm, and hides nothing.

        Its stamp is when it was measured, on the publisher's clock; one that repeats it grows old.
        """
        if self._heard is None or any(name in message.name for name in self.ros_names):
            seconds = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            self._heard = self._stamped(seconds), message

    def connect(self) -> ArmInfo:
        """See Driver."""
        self._stamped = DeviceClock(self.clock.now)
        return ArmInfo(self.robot, self.names, (), ("joint",), RATE)

    def listen(self) -> ArmInfo:
        """As ``connect``: what can move the arm is the publisher, and without one nothing is sent."""
        return self.connect()

    def read(self) -> State:
        """See Driver. Joints are looked up by name: /joint_states has an order of its own.

        An interface that an arm does not have is NaN there, of one joint or of all; it is then not reported at all. One that was
        there and is NaN now stays NaN, which holds the arm.

        Raises:
            ToolkitError: nothing was heard yet, or a joint is missing.
        """
        if self._heard is None:
            raise ToolkitError("nothing came on /joint_states yet; is the driver running, and is the node spun?")
        stamp, message = self._heard
        names = list(message.name)
        missing = [name for name in self.ros_names if name not in names]
        if missing:
            raise ToolkitError(f"/joint_states has no joint {missing[0]!r}; it has {', '.join(names)}")
        order = [names.index(name) for name in self.ros_names]
        if len(message.position) != len(names):
            raise ToolkitError(f"/joint_states names {len(names)} joints and has {len(message.position)} positions")
        position, quaternion, goal, seen = self.scene()
        speeds, efforts = self._present("speed", message.velocity, order), self._present("effort", message.effort, order)
        stamp = least_fresh(self.clock.now(), stamp, seen)
        return State(stamp, np.array(message.position, float)[order], position, quaternion, goal, opening=self.opening(),
                     speeds=speeds, efforts=efforts, fault=self._stopped)

    def _present(self, what: str, values: Sequence[float], order: list[int]) -> np.ndarray | None:
        """What a message says of an interface, (n,) in the arm's order; None where the arm does not have it for every joint."""
        found = np.array(values, float)[order] if len(values) > max(order) else np.full(len(order), np.nan)
        if np.isfinite(found).all():
            self._there.add(what)
        return found if what in self._there else None

    def send(self, command: Command) -> Command:
        """See Driver. A hold is a trajectory of one point, with no speed.

        Raises:
            ToolkitError: another form than joint.
        """
        if command.form != "joint":
            raise ToolkitError(f"this driver takes joint commands, not {command.form!r}")
        if self.publisher is None:
            raise ToolkitError("this driver only listens: it has no publisher")
        rows = command.waypoints[-1:] if command.hold else command.waypoints
        message = self.trajectory()
        message.joint_names = list(self.ros_names)
        message.points = [self._point(row, (i + 1) * PERIOD / len(rows)) for i, row in enumerate(rows)]
        message.points[-1].velocities = command.rate.tolist()
        self.publisher.publish(message)
        if not command.hold:
            self.gripper(command.opening, command.opening_m)
        return command

    def _point(self, row: np.ndarray, seconds: float) -> Any:
        point = self.point()
        point.positions = row.tolist()
        point.time_from_start = self.duration(sec=int(seconds), nanosec=int(round(1e9 * (seconds % 1.0))))
        return point

    def stop(self, reason: str) -> None:
        """See Driver: an empty trajectory makes the controller hold where it is."""
        self._stopped = self._stopped or reason
        if self.publisher is None:
            return
        message = self.trajectory()
        message.joint_names, message.points = list(self.ros_names), []
        self.publisher.publish(message)


# ---- the node --------------------------------------------------------------------------------------------------------


def open_arm(
    robot: str, joints: Sequence[str], scene: Scene, gripper: Grip | None = None, opening: Callable[[], float] | None = None,
    ros_names: Sequence[str] | None = None, listens: bool = False, name: str = "meta_evolve", clock: Clock = WALL,
) -> tuple[Ros2, Callable[[], None]]:
    """An arm of the ROS 2 graph, through a node of its own that a thread spins.

    Args:
        robot: the toolkit's name of the system.
        joints: names of the arm's joints in the bundle, base to flange.
        scene: reads the cameras.
        gripper: moves the gripper; None: nothing does.  opening: reads it, 0 closed to 1 open; None: it counts as open.
        ros_names: the joints' names in ROS; None: JOINT_NAMES.
        listens: make no publisher.
        name: of the node.
        clock: of the stamps.

    Returns:
        the arm, and what closes its node.

    Raises:
        ToolkitError: rclpy is not there, or nobody knows the joints' names in ROS.
    """
    names = tuple(ros_names) if ros_names else JOINT_NAMES.get(robot, ())
    if len(names) != len(joints):
        raise ToolkitError(f"robot {robot!r} has {len(joints)} joints, and {len(names)} names of them in ROS are known; give ros_names")
    try:
        import rclpy
        from builtin_interfaces.msg import Duration
        from sensor_msgs.msg import JointState
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
    except ImportError as error:
        raise ToolkitError(f"the ROS 2 driver needs rclpy ({error}); source your ROS 2 installation in this shell first") from None
    if not rclpy.ok():
        rclpy.init()
    node = rclpy.create_node(name)
    publisher = None if listens else node.create_publisher(JointTrajectory, TRAJECTORY, 1)
    arm = Ros2(publisher, JointTrajectory, JointTrajectoryPoint, Duration, robot, joints, names, scene, gripper or _nothing,
               opening or _open, clock)
    node.create_subscription(JointState, STATES, arm.heard, 1)
    ended = threading.Event()

    def spin() -> None:
        while not ended.is_set() and rclpy.ok():
            rclpy.spin_once(node, timeout_sec=0.1)

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()

    def close() -> None:
        ended.set()
        thread.join(timeout=1.0)
        node.destroy_node()

    return arm, close


def _nothing(opening: float, opening_m: float) -> None:
    pass


def _open() -> float:
    return 1.0


def controllers_yaml(manifest: Manifest, ros_names: Sequence[str], update_hz: int = 1000) -> str:
    """The controller manager's parameters for a bundle's arm, as YAML.

    Every trajectory that is sent ends in motion, 50 ms ahead: a controller that does not allow this refuses them all. It holds
    WATCHDOG seconds after the last one.

    Args:
        manifest: of the bundle.
        ros_names: the arm's joints in ROS, base to flange.
        update_hz: of the controller manager: the arm's own rate.

    Raises:
        ToolkitError: another number of names than the arm has joints.
    """
    if len(ros_names) != len(manifest.joints):
        raise ToolkitError(f"the bundle's arm has {len(manifest.joints)} joints, not {len(ros_names)}; name each")
    lines = [
        "controller_manager:", "  ros__parameters:", f"    update_rate: {update_hz}", "    joint_state_broadcaster:",
        "      type: joint_state_broadcaster/JointStateBroadcaster", "    joint_trajectory_controller:",
        "      type: joint_trajectory_controller/JointTrajectoryController", "", "joint_trajectory_controller:", "  ros__parameters:",
        "    joints:", *(f"      - {name}" for name in ros_names), "    command_interfaces:", "      - position",
        "    state_interfaces:", "      - position", "      - velocity", "    allow_partial_joints_goal: false",
        "    allow_nonzero_velocity_at_trajectory_end: true", f"    cmd_timeout: {WATCHDOG}", "    constraints:", "      goal_time: 0.0",
        *(f"      {name}:\n        trajectory: {manifest.watch.tracking_rad}" for name in ros_names),
    ]
    return "\n".join(lines) + "\n"


# ---- tf --------------------------------------------------------------------------------------------------------------


def static_transform(manifest: Manifest, base_turn: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Where the task frame lies in the arm's base frame, for a static transform: translation (3,) [m], quaternion (4,) x y z w.

    ``ros2 run tf2_ros static_transform_publisher --x .. --y .. --z .. --qx .. --qy .. --qz .. --qw .. --frame-id base_link
    --child-frame-id task`` publishes it.

    Args:
        manifest: of the bundle.
        base_turn: rotation (3, 3) of the driver's base_link in the bundle's base frame; None: they are one.
    """
    robot = manifest.robot
    base = matrix_of(np.array(robot.base_quaternion)) @ (np.eye(3) if base_turn is None else np.asarray(base_turn, float))
    return -base.T @ np.array(robot.base_position_m), np.roll(quaternion_of(base.T), -1)


class TfScene:
    """The cameras through tf: where a detector publishes the object, and the goal as the bundle has it.

    Args:
        lookup: tf2's ``Buffer.lookup_transform``.
        latest: rclpy's ``Time()``: the newest transform there is.
        manifest: of the bundle.
        object_frame: that the detector publishes; its origin is the object's centre, its axes the task's when it stands upright unturned.
        errors: that ``lookup`` raises where there is no transform: (tf2_ros.TransformException,).
        task_frame: see ``static_transform``.
    """

    def __init__(
        self, lookup: Callable[..., Any], latest: Any, manifest: Manifest, object_frame: str, errors: tuple[type[Exception], ...],
        task_frame: str = "task",
    ) -> None:
        self._lookup, self._latest, self._frames, self._errors = lookup, latest, (task_frame, object_frame), errors
        self._offset = np.array(manifest.task.goal_offset_m)
        self._goal: np.ndarray | None = None
        self._clock = DeviceClock()

    def begin(self) -> None:
        """A new episode: the goal counts from where the object is seen next."""
        self._goal = None

    def __call__(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """See Scene; the stamp is the transform's own.

        Raises:
            ToolkitError: tf has no such transform.
        """
        try:
            found = self._lookup(*self._frames, self._latest)
        except self._errors as error:
            raise ToolkitError(f"tf has no {self._frames[1]!r} in {self._frames[0]!r} ({error}); does the detector run?") from None
        place, turn, stamp = found.transform.translation, found.transform.rotation, found.header.stamp
        position = np.array([place.x, place.y, place.z], float)
        if self._goal is None:
            self._goal = position + self._offset
        return position, np.array([turn.w, turn.x, turn.y, turn.z], float), self._goal, self._clock(stamp.sec + 1e-9 * stamp.nanosec)


# ---- the gripper -----------------------------------------------------------------------------------------------------


class GripperAction:
    """Moves a gripper through its action; a Grip.

    Args:
        client: rclpy's ActionClient of it.
        goal: makes an empty goal: control_msgs' ``GripperCommand.Goal``, or ``ParallelGripperCommand.Goal`` with ``joint``.
        opened, closed: joint positions [rad or m] at the openings 1 and 0; the driver's, not the bundle's.
        effort: largest [N m or N].
        joint: that the newer action names; empty: the older one, which names none.
    """

    def __init__(self, client: Any, goal: Callable[[], Any], opened: float, closed: float, effort: float, joint: str = "") -> None:
        self.client, self.goal, self.opened, self.closed, self.effort, self.joint = client, goal, opened, closed, effort, joint
        self._told: float | None = None

    def __call__(self, opening: float, opening_m: float) -> None:
        """Send a goal, without waiting for its end; a new one takes over from the last."""
        if self._told is not None and abs(opening - self._told) < NEWS:
            return
        goal = self.goal()
        position = self.closed + (self.opened - self.closed) * opening
        if self.joint:
            goal.command.name, goal.command.position, goal.command.effort = [self.joint], [position], [self.effort]
        else:
            goal.command.position, goal.command.max_effort = position, self.effort
        self.client.send_goal_async(goal)
        self._told = opening


class JointOpening:
    """How far a gripper is open, from its joint on /joint_states.

    Args:
        joint: its name in ROS.  opened, closed: its positions [rad or m] at the openings 1 and 0.
        now: our clock [s].
    """

    def __init__(self, joint: str, opened: float, closed: float, now: Callable[[], float] = time.monotonic) -> None:
        self.joint, self.opened, self.closed, self._now = joint, opened, closed, now
        self._heard: tuple[float, float] | None = None

    def heard(self, message: Any) -> None:
        """Callback for /joint_states; messages without the joint say nothing."""
        if self.joint in message.name:
            self._heard = self._now(), float(message.position[list(message.name).index(self.joint)])

    def __call__(self) -> float:
        """0 closed to 1 open; not a number if nothing came for a second, which holds the arm."""
        if self._heard is None or self._now() - self._heard[0] > 1.0:
            return float("nan")
        return (self._heard[1] - self.closed) / (self.opened - self.closed)
