"""Compiled arithmetic of F: what MuJoCo calls a link, an axis, a rotation and a bone, from what the evolution space calls them.

Quaternions are w first.
"""

import math

import numba
import numpy as np

VANISHING = 1e-9
"""Length [m] below which a bone points upwards."""


@numba.njit(cache=True, nogil=True)
def _eigen(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (3,) and a rotation (3, 3) with the eigenvectors as columns, of a symmetric matrix (Jacobi 1846)."""
    a, v = matrix.copy(), np.eye(3)
    for _ in range(50):
        off = a[0, 1] ** 2 + a[0, 2] ** 2 + a[1, 2] ** 2
        if off <= 1e-32 * (a[0, 0] ** 2 + a[1, 1] ** 2 + a[2, 2] ** 2) or off < 1e-300:
            break
        for p, q in ((0, 1), (0, 2), (1, 2)):
            if a[p, q] != 0.0:
                ratio = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = math.copysign(1.0, ratio) / (abs(ratio) + math.sqrt(1.0 + ratio * ratio))
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = t * c
                for k in range(3):
                    a[k, p], a[k, q] = c * a[k, p] - s * a[k, q], s * a[k, p] + c * a[k, q]
                for k in range(3):
                    a[p, k], a[q, k] = c * a[p, k] - s * a[q, k], s * a[p, k] + c * a[q, k]
                for k in range(3):
                    v[k, p], v[k, q] = c * v[k, p] - s * v[k, q], s * v[k, p] + c * v[k, q]
    return np.array([a[0, 0], a[1, 1], a[2, 2]]), v


@numba.njit(cache=True, nogil=True)
def quaternion(r: np.ndarray) -> np.ndarray:
    """Quaternion (4,) of a rotation matrix (3, 3), by its largest component (Shepperd 1978)."""
    out = np.empty(4)
    squares = np.array([1 + r[0, 0] + r[1, 1] + r[2, 2], 1 + r[0, 0] - r[1, 1] - r[2, 2],
                        1 - r[0, 0] + r[1, 1] - r[2, 2], 1 - r[0, 0] - r[1, 1] + r[2, 2]])
    largest = np.argmax(squares)
    twice = math.sqrt(squares[largest])
    out[largest] = 0.5 * twice
    scale = 0.5 / twice
    if largest == 0:
        out[1], out[2], out[3] = scale * (r[2, 1] - r[1, 2]), scale * (r[0, 2] - r[2, 0]), scale * (r[1, 0] - r[0, 1])
    elif largest == 1:
        out[0], out[2], out[3] = scale * (r[2, 1] - r[1, 2]), scale * (r[0, 1] + r[1, 0]), scale * (r[0, 2] + r[2, 0])
    elif largest == 2:
        out[0], out[1], out[3] = scale * (r[0, 2] - r[2, 0]), scale * (r[0, 1] + r[1, 0]), scale * (r[1, 2] + r[2, 1])
    else:
        out[0], out[1], out[2] = scale * (r[1, 0] - r[0, 1]), scale * (r[0, 2] + r[2, 0]), scale * (r[1, 2] + r[2, 1])
    return out


@numba.njit(cache=True, nogil=True)
def principal(mass: np.ndarray, root: np.ndarray, smallest: float) -> tuple[np.ndarray, np.ndarray]:
    """Principal moments (n, 3) [kg m^2] and their frames (n, 4) of links with masses (n,) and gyrations (n, 6).

    With the root's eigenvalues g_i, the moments are m (g_j^2 + g_k^2): whatever the root, those of a possible body.

    Args:
        mass: [kg].
        root: square roots of the second moments of mass per unit mass [m], entries xx, yy, zz, xy, xz, yz.
        smallest: moment [kg m^2] below which none may lie.
    """
    moments, frames = np.empty((len(mass), 3)), np.empty((len(mass), 4))
    matrix = np.empty((3, 3))
    for i in range(len(mass)):
        for k in range(3):
            matrix[k, k] = root[i, k]
        matrix[0, 1] = matrix[1, 0] = root[i, 3]
        matrix[0, 2] = matrix[2, 0] = root[i, 4]
        matrix[1, 2] = matrix[2, 1] = root[i, 5]
        radii, axes = _eigen(matrix)
        for k in range(3):
            one, other = radii[(k + 1) % 3], radii[(k + 2) % 3]
            moments[i, k] = max(mass[i] * (one * one + other * other), smallest)
        frames[i] = quaternion(axes)
    return moments, frames


@numba.njit(cache=True, nogil=True)
def directions(tangents: np.ndarray, references: np.ndarray, bases: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3) from tangents (n, 2) [rad] at references (n, 3), whose tangent bases are (n, 2, 3)."""
    out = np.empty((len(tangents), 3))
    for i in range(len(tangents)):
        angle = math.sqrt(tangents[i, 0] ** 2 + tangents[i, 1] ** 2)
        share = math.sin(angle) / angle if angle > 1e-12 else 1.0
        for k in range(3):
            flat = tangents[i, 0] * bases[i, 0, k] + tangents[i, 1] * bases[i, 1, k]
            out[i, k] = math.cos(angle) * references[i, k] + share * flat
    return out


@numba.njit(cache=True, nogil=True)
def turned(vectors: np.ndarray, references: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4) of rotation vectors (n, 3) [rad] applied after reference quaternions (n, 4)."""
    out = np.empty((len(vectors), 4))
    for i in range(len(vectors)):
        angle = math.sqrt(vectors[i, 0] ** 2 + vectors[i, 1] ** 2 + vectors[i, 2] ** 2)
        share = math.sin(0.5 * angle) / angle if angle > 1e-12 else 0.5
        w, x, y, z = math.cos(0.5 * angle), share * vectors[i, 0], share * vectors[i, 1], share * vectors[i, 2]
        a, b, c, d = references[i]
        out[i, 0] = w * a - x * b - y * c - z * d
        out[i, 1] = w * b + x * a + y * d - z * c
        out[i, 2] = w * c - x * d + y * a + z * b
        out[i, 3] = w * d + x * c - y * b + z * a
    return out


@numba.njit(cache=True, nogil=True)
def rotations(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices (n, 3, 3) of unit quaternions (n, 4), real part first; term by term as mju_quat2Mat, to the same bits."""
    out = np.empty((len(quaternions), 3, 3))
    for i in range(len(quaternions)):
        w, x, y, z = quaternions[i]
        ww, xx, yy, zz = w * w, x * x, y * y, z * z
        out[i, 0, 0], out[i, 1, 1], out[i, 2, 2] = ww + xx - yy - zz, ww - xx + yy - zz, ww - xx - yy + zz
        out[i, 0, 1], out[i, 1, 0] = 2.0 * (x * y - w * z), 2.0 * (x * y + w * z)
        out[i, 0, 2], out[i, 2, 0] = 2.0 * (x * z + w * y), 2.0 * (x * z - w * y)
        out[i, 1, 2], out[i, 2, 1] = 2.0 * (y * z - w * x), 2.0 * (y * z + w * x)
    return out


@numba.njit(cache=True, nogil=True)
def bones(anchors: np.ndarray, tips: np.ndarray, radius: np.ndarray, shortest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Capsules from anchors (n, 3) to tips (n, 3): centres in the link frames, quaternions, sizes (radius, half length, 0)."""
    centres, frames, sizes = 0.5 * (tips - anchors), np.zeros((len(radius), 4)), np.zeros((len(radius), 3))
    for i in range(len(radius)):
        x, y, z = 2.0 * centres[i]
        length = math.sqrt(x * x + y * y + z * z)
        sizes[i, 0], sizes[i, 1] = radius[i], max(0.5 * length, shortest)
        across = math.sqrt(x * x + y * y)
        frames[i, 0] = 1.0
        if length > VANISHING and (across > 1e-12 * length or z < 0.0):  # the shortest turn of z onto the bone
            half = 0.5 * math.atan2(across, z)
            frames[i, 0] = math.cos(half)
            frames[i, 1] = -math.sin(half) * y / across if across > 1e-12 * length else 1.0
            frames[i, 2] = math.sin(half) * x / across if across > 1e-12 * length else 0.0
    return centres, frames, sizes


@numba.njit(cache=True, nogil=True)
def finger_tips(
    tips: np.ndarray, ends: np.ndarray, carrier: np.ndarray, presence: np.ndarray, positions: np.ndarray
) -> None:
    """Move the tips (n, 3) of the last links ``ends`` to the middle of their shapes, weighted by presence (m,).

    Args:
        tips: changed in place [m].
        ends: indices of links.
        carrier: link (m,) of each shape.
        presence: (m,) of each shape.
        positions: (m, 3) of each shape [m].
    """
    for end in ends:
        total, middle = 0.0, np.zeros(3)
        for shape in range(len(carrier)):
            if carrier[shape] == end:
                weight = presence[shape] + 1e-6
                total += weight
                middle += weight * positions[shape]
        if total > 0.0:
            tips[end] = middle / total
