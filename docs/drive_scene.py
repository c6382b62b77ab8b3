"""Drive a bundle's scene.xml by its recorded actions, with MuJoCo and NumPy alone: python drive_scene.py FOLDER-OF-THE-BUNDLE"""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np

folder = Path(sys.argv[1])
manifest = json.loads((folder / "manifest.json").read_text())
says, law, motors = manifest["controller"], manifest["simulation"]["osc"], manifest["simulation"]["actuators"]
golden = np.load(folder / "golden.npz", allow_pickle=False)
model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)

arm = [model.joint(joint["name"]) for joint in manifest["joints"]]
q, v = [joint.qposadr[0] for joint in arm], [joint.dofadr[0] for joint in arm]
pull = [int(np.flatnonzero(model.actuator_trnid[:, 0] == joint.id)[0]) for joint in arm]
site, base, item = model.site("grasp").id, model.site("base").id, model.body("object").id
kp, kd, null = says["kp"], 2 * says["damping_ratio"] * np.sqrt(says["kp"]), law["null_space"]
limit, posture = np.array(law["torque_limit_nm"]), np.array(null["posture_rad"])
J, of_base, M = np.zeros((6, model.nv)), np.zeros((6, model.nv)), np.zeros((model.nv, model.nv))


def rotation(vector: np.ndarray) -> np.ndarray:
    quaternion, matrix, angle = np.zeros(4), np.zeros(9), np.linalg.norm(vector)
    mujoco.mju_axisAngle2Quat(quaternion, vector / angle if angle else np.array([1.0, 0, 0]), angle)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def torques(place: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """manifest.simulation.osc.law"""
    mujoco.mj_jacSite(model, data, J[:3], J[3:], site)
    mujoco.mj_jacSite(model, data, of_base[:3], of_base[3:], base)
    mujoco.mj_fullM(model, M, data.qM)
    A, inverse, now = J[:, v], np.linalg.inv(M[np.ix_(v, v)]), data.site_xmat[site].reshape(3, 3)
    weigh = lambda rows: np.linalg.pinv(rows @ inverse @ rows.T)  # noqa: E731
    speed = A @ data.qvel[v] - of_base @ data.qvel
    turned = 0.5 * sum(np.cross(now[:, i], turn[:, i]) for i in range(3))
    force, torque = kp * (place - data.site_xpos[site]) - kd * speed[:3], kp * turned - kd * speed[3:]
    rest = M[np.ix_(v, v)] @ (null["kp"] * (posture - data.qpos[q]) - null["kd"] * data.qvel[v])
    free = np.eye(len(v)) - A.T @ weigh(A) @ A @ inverse
    pulls = A.T @ np.concatenate([weigh(A[:3]) @ force, weigh(A[3:]) @ torque]) + free @ rest + data.qfrc_bias[v]
    return np.clip(pulls, -limit, limit)


state, apart = np.array([motor["start"] for motor in motors]), []
for now, action in enumerate(golden["episode_actions"][:-1]):
    sign = np.array([motor["sign"] for motor in motors])
    state = np.clip(state + sign * manifest["gripper"]["rate"] * np.sign(action[6]), -1, 1)
    for motor, s in zip(motors, state, strict=True):
        data.ctrl[model.actuator(motor["name"]).id] = motor["low"] + 0.5 * (s + 1) * (motor["high"] - motor["low"])
    for step in range(manifest["simulation"]["physics"]["substeps"]):
        mujoco.mj_step1(model, data)
        R, origin = data.site_xmat[base].reshape(3, 3), data.site_xpos[base]
        if step == 0:  # the goal counts from where the grasp frame is now, in the frame of the controller's base, and moves with it
            goal = R.T @ (data.site_xpos[site] - origin) + says["translation_m"] * action[:3]
            goal_turn = rotation(says["rotation_rad"] * action[3:6]) @ R.T @ data.site_xmat[site].reshape(3, 3)
        data.ctrl[pull] = torques(origin + R @ goal, R @ goal_turn)
        mujoco.mj_step2(model, data)
    mujoco.mj_kinematics(model, data)  # golden.npz has angles and poses of one instant
    apart.append((np.abs(data.qpos[q] - golden["episode_joints"][now + 1]).max(),
                  np.abs(data.xpos[item] - golden["episode_object_position"][now + 1]).max()))
angle, way = np.max(apart, axis=0)
print(json.dumps({"steps": len(apart), "arm_rad": float(angle), "object_m": float(way)}))  # noqa: T201
sys.exit(int(max(angle, way) > 1e-4))  # rad and m; contacts enlarge what hulls and processors round differently
