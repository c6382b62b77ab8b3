"""Any arm behind ros2_control's joint_trajectory_controller: a skeleton. Its conversions are tested against a fake; nothing
of it was run on hardware, nor with a ROS 2 installation.

Pass in a running rclpy node and the message classes, so that this file needs no ROS to be imported:

    from builtin_interfaces.msg import Duration
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
    publisher = node.create_publisher(JointTrajectory, "/joint_trajectory_controller/joint_trajectory", 1)
    arm = Ros2(publisher, JointTrajectory, JointTrajectoryPoint, Duration, "iiwa", joints, ros_names, scene, gripper, opening)
    node.create_subscription(JointState, "/joint_states", arm.heard, 1)

What it does: joint angles by name from /joint_states, a trajectory of one tick to the controller. What you must still do:
spin the node in a thread of its own, configure the controller's own tolerances, and connect the gripper's action.
ROS speaks rad and m; its quaternions are x y z w, so your scene must turn them round.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from toolkit.deploy.arm import ArmInfo, Command, State
from toolkit.deploy.drivers.stamps import DeviceClock
from toolkit.deploy.drivers.ur import Grip, Scene
from toolkit.errors import ToolkitError

RATE = 100.0
"""[Hz] of the waypoints in a trajectory."""
PERIOD = 0.05
"""[s] of a tick."""

class Ros2:
    """An arm behind a joint_trajectory_controller.

    Args:
        publisher: of JointTrajectory messages.
        trajectory, point, duration: the message classes.
        robot: the toolkit's name of the system.
        joints: names of the arm's joints in the bundle, base to flange.  ros_names: the same joints' names in ROS.
        scene: reads the cameras.
        gripper: moves the gripper.  opening: reads it, 0 closed to 1 open.
    """

    def __init__(
        self, publisher: Any, trajectory: Any, point: Any, duration: Any, robot: str, joints: Sequence[str], ros_names: Sequence[str],
        scene: Scene, gripper: Grip, opening: Callable[[], float],
    ) -> None:  # fmt: skip
        self.publisher, self.trajectory, self.point, self.duration = publisher, trajectory, point, duration
        self.robot, self.names, self.ros_names = robot, tuple(joints), tuple(ros_names)
        self.scene, self.gripper, self.opening = scene, gripper, opening
        self._heard: tuple[float, Any] | None = None
        self._there: set[str] = set()  # what has been a number for every joint, and is to be one from then on
        self._stopped = ""
        self._clock = DeviceClock()

    def heard(self, message: Any) -> None:
        """Callback for /joint_states, on which several may speak: a gripper's own message says nothing of the arm, and hides nothing.

        Its stamp is when it was measured, on the publisher's clock; one that repeats it grows old.
        """
        if self._heard is None or any(name in message.name for name in self.ros_names):
            seconds = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            self._heard = self._clock(seconds), message

    def connect(self) -> ArmInfo:
        """See Driver."""
        return ArmInfo(self.robot, self.names, (), ("joint",), RATE)

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
        return State(min(stamp, seen), np.array(message.position, float)[order], position, quaternion, goal, opening=self.opening(),
                     speeds=speeds, efforts=efforts, fault=self._stopped)  # fmt: skip

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
        message = self.trajectory()
        message.joint_names, message.points = list(self.ros_names), []
        self.publisher.publish(message)
