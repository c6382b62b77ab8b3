"""robosuite's operational-space control of one policy step, compiled: OSC_POSE, fixed impedance, delta input.

The functions call libmujoco's own mj_step1, mj_step2, mj_jacSite and mj_fullM on the addresses of an mjModel and its
mjData, and hold no lock, so that threads play episodes side by side.

Control law (Khatib 1987; robosuite 1.5.1, controllers/parts/arm/osc.py), per substep:

    F = kp e_p + kd e_v,  T = kp e_R + kd e_w           errors of position, rotation and their rates
    tau = J^T [L_p F; L_r T] + bias + N^T M (k (q0 - q) - 2 sqrt(k) qd)
    L_p = (Jp M^-1 Jp^T)^-1,  L_r likewise,  N = I - M^-1 J^T L J

The goal is set once per policy step from the achieved pose, in the frame of the robot's base. robosuite takes
pseudo-inverses where this file solves with a Cholesky factor: equal away from singular configurations.
"""

import math

import llvmlite.binding
import mujoco
import numba
import numpy as np
from numba import types

POSITION_SCALE = 0.05
"""Goal displacement [m] per unit of action: robosuite's default OSC_POSE output_max."""
ROTATION_SCALE = 0.5
"""Goal rotation [rad] per unit of action: robosuite's default OSC_POSE output_max."""
KP = 150.0
"""Stiffness [1/s^2]: robosuite's default kp."""
KD = 2.0 * math.sqrt(KP)
"""Damping [1/s]: damping ratio 1."""
NULL_KP = 10.0
"""Stiffness [1/s^2] of the posture in the null space: robosuite's nullspace_torques."""


def _library() -> str:
    """Path of the MuJoCo library that the Python package has loaded."""
    from pathlib import Path

    folder = Path(mujoco.__file__).parent
    found = [*folder.glob("libmujoco.so*"), *folder.glob("libmujoco*.dylib"), *folder.glob("mujoco.dll")]
    if not found:
        raise ImportError(f"no MuJoCo library in {folder}")
    return str(found[0])


llvmlite.binding.load_library_permanently(_library())
_ptr = types.uintp
_void = types.void
_mj_step1 = types.ExternalFunction("mj_step1", _void(_ptr, _ptr))
_mj_step2 = types.ExternalFunction("mj_step2", _void(_ptr, _ptr))
_mj_jac_site = types.ExternalFunction("mj_jacSite", _void(_ptr, _ptr, _ptr, _ptr, types.int32))
_mj_full_m = types.ExternalFunction("mj_fullM", _void(_ptr, _ptr, _ptr))


@numba.njit(cache=True, nogil=True)
def rotation_from_vector(vector: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a rotation vector (3,) [rad] (Rodrigues)."""
    angle = math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    out = np.eye(3)
    if angle < 1e-12:
        return out
    x, y, z = vector[0] / angle, vector[1] / angle, vector[2] / angle
    s, c = math.sin(angle), math.cos(angle)
    v = 1.0 - c
    out[0, 0], out[0, 1], out[0, 2] = c + x * x * v, x * y * v - z * s, x * z * v + y * s
    out[1, 0], out[1, 1], out[1, 2] = y * x * v + z * s, c + y * y * v, y * z * v - x * s
    out[2, 0], out[2, 1], out[2, 2] = z * x * v - y * s, z * y * v + x * s, c + z * z * v
    return out


@numba.njit(cache=True, nogil=True)
def cholesky_solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """X (n, m) with matrix (n, n) X = right (n, m), for a symmetric positive definite matrix; NaN if it is not."""
    n, m = right.shape
    low = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= low[i, k] * low[j, k]
            if i == j:
                low[i, i] = math.sqrt(total) if total > 0.0 else math.nan
            else:
                low[i, j] = total / low[j, j]
    out = right.copy()
    for column in range(m):
        for i in range(n):
            total = out[i, column]
            for k in range(i):
                total -= low[i, k] * out[k, column]
            out[i, column] = total / low[i, i]
        for i in range(n - 1, -1, -1):
            total = out[i, column]
            for k in range(i + 1, n):
                total -= low[k, i] * out[k, column]
            out[i, column] = total / low[i, i]
    return out


@numba.njit(cache=True, nogil=True)
def osc_torque(
    mass: np.ndarray, jacobian: np.ndarray, force: np.ndarray, bias: np.ndarray, posture: np.ndarray
) -> np.ndarray:
    """Joint torques (n,) [N m] of the control law in this module's docstring.

    Args:
        mass: M (n, n) [kg m^2], armature included.
        jacobian: J (6, n), translation above rotation.
        force: desired acceleration F over T (6,) [m/s^2, rad/s^2].
        bias: gravity and Coriolis torques (n,) [N m].
        posture: desired null-space acceleration (n,) [rad/s^2].
    """
    minv_jt = cholesky_solve(mass, np.ascontiguousarray(jacobian.T))
    task = jacobian @ minv_jt
    wrench = np.empty((6, 1))
    wrench[:3] = cholesky_solve(np.ascontiguousarray(task[:3, :3]), force[:3].copy().reshape(3, 1))
    wrench[3:] = cholesky_solve(np.ascontiguousarray(task[3:, 3:]), force[3:].copy().reshape(3, 1))
    pull = mass @ posture
    # N^T p = p - J^T L (J M^-1 p), and M^-1 p is the posture acceleration itself.
    null = cholesky_solve(task, (jacobian @ posture).reshape(6, 1))
    return jacobian.T @ (wrench[:, 0] - null[:, 0]) + bias + pull


@numba.njit(cache=True, nogil=True)
def base_rotation(follows: float, turned: float, axis: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of the OSC base frame after joint 1 has turned [rad] about its axis (3,); follows in [0, 1]."""
    return rotation_from_vector(follows * turned * axis)


@numba.njit(cache=True, nogil=True)
def control_step(
    model: int,
    data: int,
    substeps: int,
    action: np.ndarray,
    finger_ctrl: np.ndarray,
    arm_qpos: np.ndarray,
    arm_dof: np.ndarray,
    arm_actuator: np.ndarray,
    finger_actuator: np.ndarray,
    site: int,
    posture: np.ndarray,
    torque_limit: np.ndarray,
    base_follows: float,
    base_axis: np.ndarray,
    base_anchor: np.ndarray,
    base_origin: np.ndarray,
    qpos: np.ndarray,
    qvel: np.ndarray,
    ctrl: np.ndarray,
    bias: np.ndarray,
    inertia: np.ndarray,
    site_xpos: np.ndarray,
    site_xmat: np.ndarray,
) -> None:
    """One policy step: ``substeps`` of physics under OSC with a goal set once.

    Args:
        model, data: addresses of the mjModel and mjData.
        action: (6,) translation and rotation deltas in [-1, 1].
        finger_ctrl: (n_finger,) controls of the finger actuators [rad].
        arm_qpos, arm_dof, arm_actuator, finger_actuator: indices.
        site: id of the grasp frame's site.
        posture: arm configuration (n,) [rad] that the null space holds.
        torque_limit: (n,) [N m].
        base_follows, base_axis, base_anchor, base_origin: how the OSC base frame turns with joint 1 (3,) world.
        qpos, qvel, ctrl, bias, inertia, site_xpos, site_xmat: views of the mjData (nq,) (nv,) (nu,) (nv,) (nM,)
            (nsite, 3) (nsite, 9).
    """
    n, nv = arm_dof.shape[0], qvel.shape[0]
    jacp, jacr, full = np.zeros((3, nv)), np.zeros((3, nv)), np.zeros((nv, nv))
    jacobian, mass, force = np.empty((6, n)), np.empty((n, n)), np.empty(6)
    goal_position, goal_rotation = np.empty(3), np.eye(3)
    for substep in range(substeps):
        _mj_step1(model, data)
        position = site_xpos[site]
        rotation = site_xmat[site].reshape(3, 3)
        turned = qpos[arm_qpos[0]] - posture[0]
        base = base_rotation(base_follows, turned, base_axis)
        origin = base_anchor + base @ (base_origin - base_anchor)
        if substep == 0:
            delta = np.minimum(np.maximum(action, -1.0), 1.0)
            goal_position = base.T @ (position - origin) + POSITION_SCALE * delta[:3]
            goal_rotation = rotation_from_vector(ROTATION_SCALE * delta[3:]) @ (base.T @ rotation)
        _mj_jac_site(model, data, jacp.ctypes.data, jacr.ctypes.data, site)
        _mj_full_m(model, full.ctypes.data, inertia.ctypes.data)
        for i in range(n):
            for k in range(3):
                jacobian[k, i] = jacp[k, arm_dof[i]]
                jacobian[3 + k, i] = jacr[k, arm_dof[i]]
            for j in range(n):
                mass[i, j] = full[arm_dof[i], arm_dof[j]]
        spin = base_follows * qvel[arm_dof[0]] * base_axis
        velocity = jacobian @ qvel[arm_dof]
        wanted = base @ goal_rotation
        error = np.zeros(3)
        for k in range(3):
            error += 0.5 * np.cross(rotation[:, k], wanted[:, k])
        force[:3] = KP * (origin + base @ goal_position - position) - KD * (velocity[:3] - np.cross(spin, origin - base_anchor))
        force[3:] = KP * error - KD * (velocity[3:] - spin)
        pull = NULL_KP * (posture - qpos[arm_qpos]) - 2.0 * math.sqrt(NULL_KP) * qvel[arm_dof]
        torque = osc_torque(mass, jacobian, force, bias[arm_dof], pull)
        for i in range(n):
            ctrl[arm_actuator[i]] = min(max(torque[i], -torque_limit[i]), torque_limit[i])
        for i in range(finger_actuator.shape[0]):
            ctrl[finger_actuator[i]] = finger_ctrl[i]
        _mj_step2(model, data)
