"""An ant looks the same after a quarter turn, so whoever can run east, turned by an eighth at most, can run anywhere without turning.

Holds for the source alone, whose four legs are alike and whose torso is round.

Observations are AntMaze's record without the place: (27,) or (N, 27); actions are (8,) or (N, 8).
"""

import numpy as np

JOINTS, SPEEDS = slice(5, 13), slice(19, 27)
"""Where angles and speeds of hips and ankles stand in the observation, leg by leg; in an action leg 4 comes first."""
ANKLE_SIGNS = np.array([1.0, -1.0, 1.0, -1.0])
"""Sign with which an ankle's angle goes over to the next leg, onto legs 1 to 4: ant.xml's axes of neighbours turn into one another so."""


WIDEST = 1.2
"""Turn [rad] from the yaw in which it was taught to run beyond which an ant that was spun about takes another leg for its first."""


def _next_leg(joints: np.ndarray) -> np.ndarray:
    """Hips and ankles (N, 8) of legs 1 to 4, each leg's given to the next one."""
    legs = np.roll(joints.reshape(-1, 4, 2), 1, axis=1)
    legs[..., 1] *= ANKLE_SIGNS
    return legs.reshape(-1, 8)


def _turned_legs(joints: np.ndarray, quarters: np.ndarray) -> np.ndarray:
    """Each row of (N, 8) given to the legs that are so many quarters (N,) of 0 to 3 further on."""
    out = np.array(joints, float)
    for turn in range(1, 4):
        rows = quarters >= turn
        out[rows] = _next_leg(out[rows])
    return out


def _rotated(vectors: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """(N, 3) turned about z by (N,) [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.column_stack([c * x - s * y, s * x + c * y, z])


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Hamilton products (N, 4) of quaternions, w first."""
    a, u, b, v = first[:, :1], first[:, 1:], second[:, :1], second[:, 1:]
    return np.column_stack([a * b - (u * v).sum(axis=1, keepdims=True), a * v + b * u + np.cross(u, v)])


def _about_z(angle: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4) of turns about z by (N,) [rad]."""
    zero = np.zeros_like(angle)
    return np.column_stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)])


def eastwards(observations: np.ndarray, headings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What an ant that runs in some direction would see if that were east, and another leg the first.

    The leg that would be the first of an ant whose yaw is 0, so that an ant which turns to where it is taught to face keeps that yaw in
    every corridor: it then has few ways to move, and whoever shall learn them by looking on has less to learn.

    Args:
        observations: (N, 27).
        headings: (N,) [rad] from east, counterclockwise.

    Returns:
        (N, 27), and by how many quarters (N,) of 0 to 3 each leg's part was given on.
    """
    out = np.array(observations, float)
    turned = _product(_about_z(-headings), out[:, 1:5])
    w, x, y, z = turned.T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    quarters = np.round(-headings / (np.pi / 2))
    apart = np.angle(np.exp(1j * (yaw - quarters * np.pi / 2)))
    quarters += np.where(np.abs(apart) > WIDEST, np.round(apart / (np.pi / 2)), 0.0)
    turned = _product(turned, _about_z(-quarters * np.pi / 2))
    out[:, 1:5] = np.where(turned[:, :1] < 0, -turned, turned)
    out[:, 13:16] = _rotated(out[:, 13:16], -headings)
    out[:, 16:19] = _rotated(out[:, 16:19], quarters * np.pi / 2)
    quarters = quarters.astype(int) % 4
    for part in (JOINTS, SPEEDS):
        out[:, part] = _turned_legs(out[:, part], quarters)
    return out, quarters


def given_back(actions: np.ndarray, quarters: np.ndarray) -> np.ndarray:
    """Actions (N, 8) for what ``eastwards`` showed, as they are for the ant's own legs."""
    legs = np.roll(actions.reshape(-1, 4, 2), -1, axis=1).reshape(-1, 8)
    own = _turned_legs(legs, (4 - quarters) % 4)
    return np.roll(own.reshape(-1, 4, 2), 1, axis=1).reshape(-1, 8)
