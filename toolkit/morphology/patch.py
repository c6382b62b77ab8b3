"""What F writes at an evolution parameter."""

from dataclasses import dataclass

import numpy as np


@dataclass
class Patch:
    """What F writes, as arrays over slots, shapes and couplings (all in MuJoCo's own meaning)."""

    anchor: np.ndarray
    freeze: np.ndarray
    body_pos: np.ndarray
    grasp_pos: np.ndarray
    axis: np.ndarray
    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    inertia_quat: np.ndarray
    air_pos: np.ndarray
    air_quat: np.ndarray
    air_inertia: np.ndarray
    limits: np.ndarray
    margin: np.ndarray
    lock: np.ndarray
    spring: np.ndarray
    spring_quadratic: np.ndarray
    spring_rest: np.ndarray
    damping: np.ndarray
    armature: np.ndarray
    friction_loss: np.ndarray
    gain: np.ndarray
    start_target: np.ndarray
    preshape: float
    rate: float
    shape_pos: np.ndarray
    shape_quat: np.ndarray
    shape_size: np.ndarray
    shape_contact: np.ndarray
    shape_activity: np.ndarray
    shape_friction: np.ndarray
    shape_solref: np.ndarray
    shape_margin: np.ndarray
    coupling: np.ndarray
    coupling_stiffness: np.ndarray
    coupling_slack: np.ndarray
    coupling_limits: np.ndarray
    coupling_friction: np.ndarray
    coupling_impedance: np.ndarray
    coupling_time: np.ndarray
    coupling_length: np.ndarray
    coupling_held: np.ndarray
    curve: np.ndarray
    curve_stiffness: np.ndarray
    torque_limit: np.ndarray
    bone_pos: np.ndarray
    bone_quat: np.ndarray
    bone_size: np.ndarray
