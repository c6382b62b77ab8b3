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

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from toolkit.deploy.arm import ArmInfo, Command, State
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
        self._stopped = ""

    def heard(self, message: Any) -> None:
        """Callback for /joint_states."""
        self._heard = time.monotonic(), message

    def connect(self) -> ArmInfo:
        """See Driver."""
        return ArmInfo(self.robot, self.names, (), ("joint",), RATE)

    def read(self) -> State:
        """See Driver. Joints are looked up by name: /joint_states has an order of its own.

        Raises:
            ToolkitError: nothing was heard yet, or a joint is missing.
        """
        if self._heard is None:
            raise ToolkitError("nothing came on /joint_states yet; is the driver running, and is the node spun?")
        stamp, message = self._heard
        missing = [name for name in self.ros_names if name not in message.name]
        if missing:
            raise ToolkitError(f"/joint_states has no joint {missing[0]!r}; it has {', '.join(message.name)}")
        order = [list(message.name).index(name) for name in self.ros_names]
        position, quaternion, goal, seen = self.scene()
        pick = lambda values: np.array(values, float)[order] if len(values) == len(message.name) else None  # noqa: E731
        return State(min(stamp, seen), pick(message.position), position, quaternion, goal, opening=self.opening(),
                     speeds=pick(message.velocity), efforts=pick(message.effort), fault=self._stopped)  # fmt: skip

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
