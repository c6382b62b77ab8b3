"""robosuite's operational-space control of one policy step, compiled: OSC_POSE, fixed impedance, delta input.

The functions call libmujoco's own mj_step1 and mj_step2 on the addresses of an mjModel and its mjData, read everything
else from views of the mjData, and hold no lock, so that threads play episodes side by side.

Control law (Khatib 1987; robosuite 1.5.1, controllers/parts/arm/osc.py), per substep:

    F = kp e_p + kd e_v,  T = kp e_R + kd e_w           errors of position, rotation and their rates
    tau = J^T [L_p F; L_r T] + bias + N^T M (k (q0 - q) - 2 sqrt(k) qd)
    L_p = (Jp M^-1 Jp^T)^-1,  L_r likewise,  N = I - M^-1 J^T L J

The goal is set once per policy step from the achieved pose, in the frame of the robot's base.

J and M are the arm's own blocks, gathered where MuJoCo keeps them: a column of J from the joint's motion axis ``cdof``
(as mj_jacSite does), an entry of M from the sparse ``qM`` (as mj_fullM does). One Cholesky factor of M gives
J M^-1 J^T = Y^T Y with Y = C^-1 J^T, and the leading block of the factor of J M^-1 J^T is that of L_p^-1. robosuite takes
pseudo-inverses instead: the same where the arm can move its grasp frame in every direction. Where it cannot
(``SINGULAR``), this file takes them too.
"""

import ctypes
import math
from pathlib import Path
from typing import Any

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
NULL_KD = 2.0 * math.sqrt(NULL_KP)
"""Damping [1/s] of the posture: critical."""
SINGULAR = 1e-9
"""Ratio of smallest to largest squared pivot of J M^-1 J^T below which its Cholesky factor is not trusted."""


STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
"""Everything that a step of MuJoCo starts from, warm start included: the same state plays the same step, bit for bit."""


def library() -> str:
    """Path of the MuJoCo library that the Python package has loaded."""
    folder = Path(mujoco.__file__).parent
    found = [*folder.glob("libmujoco.so*"), *folder.glob("libmujoco*.dylib"), *folder.glob("mujoco.dll")]
    if not found:
        raise ImportError(f"no MuJoCo library in {folder}")
    return str(found[0])


llvmlite.binding.load_library_permanently(library())
_ptr = types.uintp
_mj_step1: Any = types.ExternalFunction("mj_step1", types.void(_ptr, _ptr))
_mj_step2: Any = types.ExternalFunction("mj_step2", types.void(_ptr, _ptr))
_mj_getState: Any = types.ExternalFunction("mj_getState", types.void(_ptr, _ptr, _ptr, types.int32))

compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
"""How functions of the inner loop are compiled: kept on disk, without the lock, division as NumPy divides."""


@numba.cfunc(types.void(types.voidptr), cache=True)
def _say_nothing(message: int) -> None:
    pass


def silence_warnings() -> None:
    """Keep MuJoCo from printing to standard output and to MUJOCO_LOG.TXT when a simulation blows up.

    The warnings stay counted in each mjData. A compiled function takes them: one of Python's would wait for its lock.
    """
    ctypes.c_void_p.in_dll(ctypes.CDLL(library()), "mju_user_warning").value = _say_nothing.address


@compiled
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


@compiled
def base_rotation(follows: float, turned: float, axis: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of the OSC base frame after joint 1 has turned [rad] about its axis (3,); follows in [0, 1]."""
    return rotation_from_vector(follows * turned * axis)


@compiled
def cholesky(matrix: np.ndarray, low: np.ndarray) -> float:
    """Write the lower factor C of a symmetric matrix (n, n) = C C^T into ``low`` (n, n); its upper half is left alone.

    Returns:
        Smallest over largest squared pivot: 1 for the identity, at most rounding for a singular matrix, and 0, with NaN in
        ``low``, for one that is not positive definite.
    """
    n = matrix.shape[0]
    least, most = math.inf, 0.0
    for i in range(n):
        for j in range(i):
            total = matrix[i, j]
            for k in range(j):
                total -= low[i, k] * low[j, k]
            low[i, j] = total / low[j, j]
        total = matrix[i, i]
        for k in range(i):
            total -= low[i, k] * low[i, k]
        least, most = min(least, total), max(most, total)
        if not total > 0.0:
            low[:, :] = math.nan
            return 0.0
        low[i, i] = math.sqrt(total)
    return least / most


@compiled
def solve_factored(low: np.ndarray, n: int, x: np.ndarray) -> None:
    """Overwrite x (n,) with the solution of C C^T x = x, C the leading (n, n) block of the lower factor ``low``."""
    for i in range(n):
        total = x[i]
        for k in range(i):
            total -= low[i, k] * x[k]
        x[i] = total / low[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= low[k, i] * x[k]
        x[i] = total / low[i, i]


@compiled
def _wrench(task: np.ndarray, force: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """[L_p F; L_r T] - L pull (6,) from J M^-1 J^T (6, 6), the desired accelerations F over T (6,) and J p (6,)."""
    whole, turning = np.empty((6, 6)), np.empty((3, 3))
    if min(cholesky(task, whole), cholesky(task[3:, 3:], turning)) > SINGULAR:
        wrench = force.copy()
        solve_factored(whole, 3, wrench[:3])
        solve_factored(turning, 3, wrench[3:])
        solve_factored(whole, 6, pull)
        return wrench - pull
    if not np.isfinite(task).all():
        return np.full(6, math.nan)
    wrench = -np.linalg.pinv(task) @ pull
    wrench[:3] += np.linalg.pinv(np.ascontiguousarray(task[:3, :3])) @ force[:3]
    wrench[3:] += np.linalg.pinv(np.ascontiguousarray(task[3:, 3:])) @ force[3:]
    return wrench


@compiled
def osc_torque(
    mass: np.ndarray, jacobian: np.ndarray, force: np.ndarray, bias: np.ndarray, posture: np.ndarray
) -> np.ndarray:
    """Joint torques (n,) [N m] of the control law in this module's docstring; NaN where M is not positive definite.

    Args:
        mass: M (n, n) [kg m^2], armature included.
        jacobian: J (6, n), translation above rotation.
        force: desired acceleration F over T (6,) [m/s^2, rad/s^2].
        bias: gravity and Coriolis torques (n,) [N m].
        posture: desired null-space acceleration p (n,) [rad/s^2].
    """
    n = mass.shape[0]
    low, half, task = np.empty((n, n)), np.empty((6, n)), np.empty((6, 6))
    cholesky(mass, low)
    for i in range(n):  # C Y = J^T; the rows of half are the columns of Y
        for row in range(6):
            total = jacobian[row, i]
            for k in range(i):
                total -= low[i, k] * half[row, k]
            half[row, i] = total / low[i, i]
    pull = np.zeros(6)
    for row in range(6):
        for column in range(row + 1):
            total = 0.0
            for i in range(n):
                total += half[row, i] * half[column, i]
            task[row, column] = task[column, row] = total
        for i in range(n):
            pull[row] += jacobian[row, i] * posture[i]
    # N^T M p = M p - J^T L (J M^-1 M p)
    wrench = _wrench(task, force, pull)
    out = np.empty(n)
    for i in range(n):
        total = bias[i]
        for row in range(6):
            total += jacobian[row, i] * wrench[row]
        for k in range(n):
            total += mass[i, k] * posture[k]
        out[i] = total
    return out


@compiled
def control_step(
    model: int,
    data: int,
    substeps: int,
    sets_goal: bool,
    action: np.ndarray,
    goal: np.ndarray,
    before: np.ndarray,
    finger_ctrl: np.ndarray,
    arm: np.ndarray,
    mass_address: np.ndarray,
    finger_actuator: np.ndarray,
    site: int,
    root: int,
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
    motion: np.ndarray,
    subtree_com: np.ndarray,
) -> None:
    """One policy step: ``substeps`` of physics under OSC with a goal set once.

    Args:
        model, data: addresses of the mjModel and mjData.
        substeps: how many.
        sets_goal: whether ``action`` sets the goal in the first of them; else the goal stays.
        action: (6,) translation and rotation deltas in [-1, 1].
        goal: (4, 3) position over rotation of the grasp frame in base axes; written where ``sets_goal``.
        before: (n_state,) STATE at the start; written where ``sets_goal``.
        finger_ctrl: (n_finger,) controls of the finger actuators [rad].
        arm: (3, n) qpos address, degree of freedom and actuator of each arm joint.
        mass_address: (n, n) where each entry of the arm's mass matrix stands in qM.
        finger_actuator: (n_finger,) indices.
        site: id of the grasp frame's site.
        root: id of the body whose subtree's centre of mass the motion axes refer to.
        posture: arm configuration (n,) [rad] that the null space holds.
        torque_limit: (n,) [N m].
        base_follows, base_axis, base_anchor, base_origin: how the OSC base frame turns with joint 1 (3,) world.
        qpos, qvel, ctrl, bias, inertia, site_xpos, site_xmat, motion, subtree_com: views of the mjData (nq,) (nv,) (nu,)
            (nv,) (nM,) (nsite, 3) (nsite, 9) (nv, 6) (nbody, 3).
    """
    n = arm.shape[1]
    jacobian, mass, force = np.empty((6, n)), np.empty((n, n)), np.empty(6)
    pull, arm_bias, velocity = np.empty(n), np.empty(n), np.empty(6)
    base, origin, spin, lever = np.eye(3), base_origin.copy(), np.zeros(3), np.zeros(3)
    position, rotation = site_xpos[site], site_xmat[site].reshape(3, 3)
    wanted = np.empty((3, 3))
    if sets_goal:
        _mj_getState(model, data, before.ctypes.data, STATE)
    for substep in range(substeps):
        _mj_step1(model, data)
        if base_follows != 0.0:
            base = base_rotation(base_follows, qpos[arm[0, 0]] - posture[0], base_axis)
            origin = base_anchor + base @ (base_origin - base_anchor)
            spin = base_follows * qvel[arm[1, 0]] * base_axis
            lever = np.cross(spin, origin - base_anchor)
        if sets_goal and substep == 0:
            delta = np.minimum(np.maximum(action, -1.0), 1.0)
            goal[0] = base.T @ (position - origin) + POSITION_SCALE * delta[:3]
            goal[1:] = rotation_from_vector(ROTATION_SCALE * delta[3:]) @ (base.T @ rotation)
        arm_x, arm_y, arm_z = position[0] - subtree_com[root, 0], position[1] - subtree_com[root, 1], position[2] - subtree_com[root, 2]
        velocity[:] = 0.0
        for i in range(n):
            dof = arm[1, i]
            wx, wy, wz = motion[dof, 0], motion[dof, 1], motion[dof, 2]
            jacobian[0, i] = motion[dof, 3] + wy * arm_z - wz * arm_y
            jacobian[1, i] = motion[dof, 4] + wz * arm_x - wx * arm_z
            jacobian[2, i] = motion[dof, 5] + wx * arm_y - wy * arm_x
            jacobian[3, i], jacobian[4, i], jacobian[5, i] = wx, wy, wz
            for row in range(6):
                velocity[row] += jacobian[row, i] * qvel[dof]
            for j in range(n):
                mass[i, j] = inertia[mass_address[i, j]]
            pull[i] = NULL_KP * (posture[i] - qpos[arm[0, i]]) - NULL_KD * qvel[dof]
            arm_bias[i] = bias[dof]
        for i in range(3):
            target = origin[i]
            for k in range(3):
                target += base[i, k] * goal[0, k]
                wanted[i, k] = base[i, 0] * goal[1, k] + base[i, 1] * goal[2, k] + base[i, 2] * goal[3, k]
            force[i] = KP * (target - position[i]) - KD * (velocity[i] - lever[i])
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            error = 0.0
            for column in range(3):
                error += rotation[j, column] * wanted[k, column] - rotation[k, column] * wanted[j, column]
            force[3 + i] = KP * 0.5 * error - KD * (velocity[3 + i] - spin[i])
        torque = osc_torque(mass, jacobian, force, arm_bias, pull)
        for i in range(n):
            ctrl[arm[2, i]] = min(max(torque[i], -torque_limit[i]), torque_limit[i])
        for i in range(finger_actuator.shape[0]):
            ctrl[finger_actuator[i]] = finger_ctrl[i]
        _mj_step2(model, data)
