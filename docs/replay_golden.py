"""Replay a bundle's recorded actions in robosuite, built from manifest.json alone: python replay_golden.py FOLDER-OF-THE-BUNDLE"""

import json
import sys
from pathlib import Path

import numpy as np
from robosuite.environments.manipulation.manipulation_env import ManipulationEnv
from robosuite.models.arenas import TableArena
from robosuite.models.objects import BoxObject, CylinderObject
from robosuite.models.tasks import ManipulationTask

folder = Path(sys.argv[1])
manifest = json.loads((folder / "manifest.json").read_text())
robot, task, start, simulation = (manifest[key] for key in ("robot", "task", "start", "simulation"))
golden = np.load(folder / "golden.npz", allow_pickle=False)


class Scene(ManipulationEnv):
    def _load_model(self) -> None:
        super()._load_model()
        arm, item, made = self.robots[0], task["object"], simulation["materials"]["object"]
        arm.robot_model.set_base_xpos(np.array(simulation["mount_position_m"]))
        arm.init_qpos = np.array(start["arm_rad"])
        arena = TableArena(task["table_size_m"], simulation["materials"]["table"]["friction"], (0, 0, task["table_top_m"]))
        arena.set_origin([0, 0, 0])
        kind = {"box": BoxObject, "cylinder": CylinderObject}[item["shape"]]
        self.item = kind("object", size=item["half_size_m"], density=simulation["object_density_kg_m3"],
                         friction=made["friction"], solref=made["solref"], solimp=made["solimp"], joints=[{"type": "free"}])
        self.model = ManipulationTask(arena, [arm.robot_model], [self.item])

    def _reset_internal(self) -> None:
        super()._reset_internal()
        arm = self.robots[0]
        self.sim.data.qpos[arm._ref_gripper_joint_pos_indexes["right"]] = golden["episode_fingers"][0]
        arm.gripper["right"].current_action = np.array([motor["start"] for motor in simulation["actuators"]])
        self.sim.forward()
        arm.part_controllers["right"].update(force=True)  # the fingers weigh on the mass matrix that it keeps
        pose = np.append(golden["episode_object_position"][0], golden["episode_object_quaternion"][0])
        self.sim.data.set_joint_qpos(self.item.joints[0], pose)

    def reward(self, action: np.ndarray | None = None) -> float:
        return 0.0


env = Scene(robots=robot["arm"], gripper_types=robot["gripper"], initialization_noise=None, control_freq=manifest["policy_hz"],
            horizon=10**6, has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False)
env.reset()
data, apart = env.sim.data._data, []
arm_joints, item = env.robots[0]._ref_joint_pos_indexes, env.sim.model.body_name2id(env.item.root_body)
for now in range(len(golden["episode_actions"]) - 1):
    env.step(golden["episode_actions"][now])
    angle = np.abs(data.qpos[arm_joints] - golden["episode_joints"][now + 1]).max()
    env.sim.forward()  # golden.npz has angles and poses of one instant
    apart.append((angle, np.abs(data.xpos[item] - golden["episode_object_position"][now + 1]).max()))
angle, place = np.max(apart, axis=0)
print(json.dumps({"steps": len(apart), "arm_rad": float(angle), "object_m": float(place)}))  # noqa: T201
sys.exit(int(max(angle, place) > 1e-4))  # rad and m; contacts enlarge what processors round differently
