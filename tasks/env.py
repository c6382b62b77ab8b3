"""The pick task as a robosuite environment, played by any arm and gripper that robosuite knows, unmodified."""

from dataclasses import dataclass

import numpy as np
from robosuite.environments.manipulation.manipulation_env import ManipulationEnv
from robosuite.models.arenas import TableArena
from robosuite.models.objects import BoxObject, CylinderObject
from robosuite.models.tasks import ManipulationTask

from robots.robot import Robot
from tasks.pick import PickTask, at_goal, is_lost
from tasks.table import OBJECT_SOLREF, TABLE_FULL_SIZE, TABLE_TOP


@dataclass(frozen=True)
class Start:
    """Where a robot starts every episode.

    Attributes:
        arm: arm configuration (n_arm,) [rad].
        fingers: gripper configuration [rad], in the order of the gripper model's joints; None: the gripper's own.
        command: robosuite's integrated gripper action at the preshape (n_gripper_actuators,); None: zero.
    """

    arm: np.ndarray
    fingers: np.ndarray | None = None
    command: np.ndarray | None = None


class Pick(ManipulationEnv):
    """Pick an object and bring it to a goal; reward 1 when the object has been held at the goal, else 0.

    Args:
        robot: the system that plays.
        task: the task.
        start: posture at the start of every episode.
        options: any further argument of robosuite's ManipulationEnv.
    """

    def __init__(self, robot: Robot, task: PickTask, start: Start, **options: object) -> None:
        self.system, self.task, self.start = robot, task, start
        self._start_rng = np.random.default_rng(0)
        options = {"has_renderer": False, "has_offscreen_renderer": False, "use_camera_obs": False} | options
        super().__init__(
            robots=robot.arm,
            gripper_types=robot.gripper.robosuite_type,
            initialization_noise=None,
            control_freq=task.control_frequency,
            horizon=task.horizon,
            hard_reset=False,
            renderer="mujoco",
            **options,
        )

    def _load_model(self) -> None:
        super()._load_model()
        robot = self.robots[0]
        robot.robot_model.set_base_xpos(np.array(self.system.base_position))
        robot.init_qpos = np.array(self.start.arm)
        arena = TableArena(table_full_size=TABLE_FULL_SIZE, table_offset=(0, 0, TABLE_TOP))
        arena.set_origin([0, 0, 0])
        item = self.task.object
        kind = BoxObject if item.shape == "box" else CylinderObject
        self.item = kind(
            name="object", size=list(item.half_size), density=item.mass / item.volume, rgba=[0.9, 0.3, 0.2, 1],
            friction=list(item.friction), solref=list(OBJECT_SOLREF), joints=[{"type": "free"}],
        )
        self.model = ManipulationTask(
            mujoco_arena=arena, mujoco_robots=[robot.robot_model], mujoco_objects=self.item
        )

    def _setup_references(self) -> None:
        super()._setup_references()
        self.object_body = self.sim.model.body_name2id(self.item.root_body)

    def begin(self, seed: int) -> dict:
        """Reset to the start that the seed determines; returns robosuite's observations."""
        self._start_rng = np.random.default_rng(seed)
        return self.reset()

    def _reset_internal(self) -> None:
        super()._reset_internal()
        gripper = self.robots[0].gripper["right"]
        if self.start.fingers is not None:
            self.sim.data.qpos[self.robots[0]._ref_gripper_joint_pos_indexes["right"]] = self.start.fingers
        if self.start.command is not None:
            gripper.current_action = np.array(self.start.command)
        # robosuite's controller has read the robot before the fingers were placed; its mass matrix must not be stale.
        self.sim.forward()
        self.robots[0].part_controllers["right"].update(force=True)
        pose, self.goal = self.task.sample_start(self._start_rng)
        self.sim.data.set_joint_qpos(self.item.joints[0], pose)
        self._judge, self.lost = self.task.judge(), False

    @property
    def object_position(self) -> np.ndarray:
        """(3,) [m], world."""
        return np.array(self.sim.data.body_xpos[self.object_body])

    @property
    def object_rotation(self) -> np.ndarray:
        """(3, 3), object to world."""
        return np.array(self.sim.data.body_xmat[self.object_body]).reshape(3, 3)

    def reward(self, action: np.ndarray | None = None) -> float:
        """1 once the object has stayed at the goal for the task's hold_steps, else 0."""
        position = self.object_position
        self.lost = self.lost or is_lost(position)
        return float(self._judge.tell(at_goal(position, self.goal, self.task.goal_tolerance)))

    @property
    def succeeded(self) -> bool:
        """Whether the object has been held at the goal for long enough."""
        return self._judge.succeeded

    def _check_success(self) -> bool:
        return self.succeeded
