"""Compiled: the posture in which a finger meets the reference box, near one that is only guessed.

Fingers are chains of screws at the start posture (product of exponentials), as everywhere in the merged robot.
"""

import numba
import numpy as np

ROUNDS = 8
"""Gauss-Newton steps."""
ENOUGH = 1e-7
"""Change [rad] of every joint in one of them from which on there is nothing left to do."""
STEP = 0.3
"""Largest change [rad] of a joint in one of them."""
GAP, TILT, HEIGHT, PITCH, STAY = 1e3, 30.0, 1e2, 8.0, 1.0
"""Weights of a gap [1/m], a pad's tilt [1/rad], a height [1/m], a round fingertip's pitch and a joint's departure from the guess
[1/rad]: a finger meets the box first of all, then with its pad as flat as meant, then at the right height, and moves no more than
that asks. A pad that leans by 10 degrees touches with an edge, 20 mm from its middle."""
FROZEN = 30.0
"""Weight of the departure of a joint that the robot lacks."""
YIELDING = 30.0
"""Stiffness [N/m] of a freezing slide's lock that doubles the weight of its departure: one of 20 kN/m, which 20 N of a motor move by a
millimetre, weighs 700, one of 200 N/m less than a hinge that freezes."""
SLIDE = 20.0
"""Radians that a metre of slide counts for."""
SLIP = 0.012
"""How far [m] a pad is moved along its link, at most: gap and tilt take the joints that could bring it to its height. With 30 mm an open
gripper was 6 mm too narrow half way to the Sawyer."""
BLUR = 1e-3
"""Difference of gaps [m] within which two shapes touch together."""
BESIDE = 4.0
"""Distance [m] for each metre of the way back to the box that a shape beside it has: what passes above is not in contact."""
FAR = 1.0
"""Gap [m] of a finger that has nothing to touch with."""


@numba.njit(cache=True, nogil=True)
def _times(turn: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A matrix (3, 3) times a vector. Written out, as all of this module's inner loops: a library's call costs ten times its sums."""
    return (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z, turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z,
            turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z)


@numba.njit(cache=True, nogil=True)
def _product(left: np.ndarray, right: np.ndarray, out: np.ndarray) -> None:
    """``left`` times ``right``, (3, 3) each, into ``out``, which is neither."""
    for i in range(3):
        for j in range(3):
            out[i, j] = left[i, 0] * right[0, j] + left[i, 1] * right[1, j] + left[i, 2] * right[2, j]


@numba.njit(cache=True, nogil=True)
def _rotation(axis: np.ndarray, angle: float, out: np.ndarray) -> None:
    """The rotation about a unit axis (3,) (Rodrigues) into ``out`` (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = axis[0], axis[1], axis[2]
    v = 1.0 - c
    out[0, 0], out[0, 1], out[0, 2] = c + x * x * v, x * y * v - z * s, x * z * v + y * s
    out[1, 0], out[1, 1], out[1, 2] = y * x * v + z * s, c + y * y * v, y * z * v - x * s
    out[2, 0], out[2, 1], out[2, 2] = z * x * v - y * s, z * y * v + x * s, c + z * z * v


@numba.njit(cache=True, nogil=True)
def place(
    angles: np.ndarray, chain: np.ndarray, anchors: np.ndarray, axes: np.ndarray, sliding: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Links of one finger: rotations (n, 3, 3) and shifts (n, 3) of points from the start, and joints' axes and points (n, 3) now.

    Args:
        angles: (n_all,) [rad, m].
        chain: (n,) indices of the finger's joints, base first.
        anchors, axes: (n_all, 3) at the start posture, world.
        sliding: (n_all,) bool.
    """
    count = len(chain)
    turns, shifts = np.empty((count, 3, 3)), np.empty((count, 3))
    now, at = np.empty((count, 3)), np.empty((count, 3))
    turn, shift, rotation = np.eye(3), np.zeros(3), np.empty((3, 3))
    for k in range(count):
        j = chain[k]
        now[k, 0], now[k, 1], now[k, 2] = _times(turn, axes[j, 0], axes[j, 1], axes[j, 2])
        x, y, z = _times(turn, anchors[j, 0], anchors[j, 1], anchors[j, 2])
        at[k, 0], at[k, 1], at[k, 2] = x + shift[0], y + shift[1], z + shift[2]
        if sliding[j]:
            turns[k] = turn
            for i in range(3):
                shifts[k, i] = shift[i] + now[k, i] * angles[j]
        else:
            _rotation(axes[j], angles[j], rotation)
            _product(turn, rotation, turns[k])
            x, y, z = _times(turns[k], anchors[j, 0], anchors[j, 1], anchors[j, 2])
            shifts[k, 0], shifts[k, 1], shifts[k, 2] = at[k, 0] - x, at[k, 1] - y, at[k, 2] - z
        turn, shift = turns[k], shifts[k]
    return turns, shifts, now, at


@numba.njit(cache=True, nogil=True)
def _reach(axes: np.ndarray, size: np.ndarray, box: bool, push: np.ndarray, off: np.ndarray, half: np.ndarray) -> float:
    """How far [m] a geom reaches from its centre along ``push`` where it is in front of the box, or next to that where it is beside it.

    A slanted link that leans over the box is no nearer to it. What counts are the geom's edges, cut to the box's width and height.

    Args:
        axes: (3, 3) the geom's axes, as columns.  push: (3,), along y.
        off: (3,) [m] its centre from the box's.  half: (3,) half extents [m] of the box.
    """
    count = 8 if box else 2
    corners = np.empty((count, 3))
    for n in range(count):
        for i in range(3):
            if box:
                corners[n, i] = off[i]
                for a in range(3):
                    corners[n, i] += (2.0 * (n >> a & 1) - 1.0) * size[a] * axes[i, a]
            else:
                corners[n, i] = off[i] + (2.0 * n - 1.0) * size[1] * axes[i, 2]
    low, high = np.empty(3), np.empty(3)
    for i in (0, 2):
        least, largest = corners[0, i], corners[0, i]
        for n in range(1, count):
            least, largest = min(least, corners[n, i]), max(largest, corners[n, i])
        low[i], high[i] = min(-half[i], largest), max(half[i], least)
    centre, best = off[0] * push[0] + off[1] * push[1] + off[2] * push[2], -FAR
    for n in range(count):
        for a in range(3 if box else 1):
            if n >> a & 1 == 0:
                first, last = corners[n], corners[n | 1 << a]
                begin, end = 0.0, 1.0
                for i in (0, 2):
                    way = last[i] - first[i]
                    if abs(way) > 1e-12:
                        one, two = (low[i] - first[i]) / way, (high[i] - first[i]) / way
                        begin, end = max(begin, min(one, two)), min(end, max(one, two))
                    elif first[i] > high[i] + 1e-12 or first[i] < low[i] - 1e-12:
                        end = -1.0
                if begin <= end + 1e-9:
                    near, rise = 0.0, 0.0
                    for i in range(3):
                        near += first[i] * push[i]
                        rise += (last[i] - first[i]) * push[i]
                    best = max(best, near + begin * rise, near + end * rise)
    if best == -FAR:  # it is in front of the box with the middle of a face only
        best = centre
    return best - centre + (0.0 if box else size[0])


@numba.njit(cache=True, nogil=True)
def gap_of(
    turns: np.ndarray, shifts: np.ndarray, mine: np.ndarray, link: np.ndarray, centres: np.ndarray, frames: np.ndarray,
    sizes: np.ndarray, boxes: np.ndarray, active: np.ndarray, push: np.ndarray, origin: np.ndarray, half: np.ndarray,
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Distance [m] of a finger from its face of the box and where it is nearest (3,); each shape's share (n,) in both, and its place.

    Nearly equal shapes share in proportion to exp(-gap / BLUR), so that distance and place move evenly from one to the next. Beside
    the box, the way back to it counts as distance as well, four times.

    Args:
        turns, shifts: from ``place``.
        mine: (n,) indices of the finger's shapes; link: index in the chain of the link of each shape of all.
        centres, frames, sizes, boxes: (m, ...) of all shapes at the start posture.  active: (m,) how much each touches, 0 to 1.
        push: (3,) towards the box, +-y.  origin: (3,) its centre.  half: (3,) its half extents.
    """
    gaps, places, shares = np.full(len(mine), FAR), np.zeros((len(mine), 3)), np.zeros(len(mine))
    off, axes = np.empty(3), np.empty((3, 3))
    for n in range(len(mine)):
        s = mine[n]
        if active[s] > 0.0:
            k = link[s]
            x, y, z = _times(turns[k], centres[s, 0], centres[s, 1], centres[s, 2])
            off[0], off[1], off[2] = x + shifts[k, 0] - origin[0], y + shifts[k, 1] - origin[1], z + shifts[k, 2] - origin[2]
            _product(turns[k], frames[s], axes)
            reach = _reach(axes, sizes[s], boxes[s], push, off, half)
            gap = -(off[0] * push[0] + off[1] * push[1] + off[2] * push[2]) - half[1] - reach
            for i in (0, 2):  # how far it reaches along x, and along z
                if boxes[s]:
                    extent = abs(axes[i, 0]) * sizes[s, 0] + abs(axes[i, 1]) * sizes[s, 1] + abs(axes[i, 2]) * sizes[s, 2]
                else:
                    extent = abs(axes[i, 2]) * sizes[s, 1] + sizes[s, 0]
                gap += BESIDE * max(0.0, abs(off[i]) - half[i] - extent)
            gaps[n] = gap
            for i in range(3):
                places[n, i] = off[i] + origin[i] + reach * push[i]
            places[n, 2] = min(max(places[n, 2], origin[2] - half[2]), origin[2] + half[2])
    least, distance, where = gaps.min() if len(mine) else FAR, FAR, np.zeros(3)
    if least < FAR:
        total = 0.0
        for n in range(len(mine)):
            shares[n] = active[mine[n]] * np.exp((least - gaps[n]) / BLUR)
            total += shares[n]
        distance = 0.0
        for n in range(len(mine)):
            shares[n] /= total
            distance += shares[n] * gaps[n]
            for i in range(3):
                where[i] += shares[n] * places[n, i]
    return distance, where, shares, places


@numba.njit(cache=True, nogil=True)
def tilt_of(
    turns: np.ndarray, mine: np.ndarray, link: np.ndarray, frames: np.ndarray, faces: np.ndarray, shares: np.ndarray,
    push: np.ndarray, sideways: np.ndarray,
) -> tuple[float, float]:
    """How far [rad] the faces of a finger's pads lean from the box's, about ``sideways``, and the pads' part in the contact.

    Args:
        faces: (m,) axis of each shape that points to the box; -1: it is round.  shares: (n,) from ``gap_of``.
        others: as for ``gap_of`` and ``meet``.
    """
    lean, part = 0.0, 0.0
    for n in range(len(mine)):
        s = mine[n]
        if faces[s] >= 0 and shares[n] > 0.0:
            normal = turns[link[s]] @ np.ascontiguousarray(frames[s][:, faces[s]])
            if normal @ push < 0.0:
                normal = -normal
            lean += shares[n] * np.arctan2(np.cross(push, normal) @ sideways, normal @ push)
            part += shares[n]
    return lean / max(part, 1e-9), part


@numba.njit(cache=True, nogil=True)
def patch_of(
    turns: np.ndarray, shifts: np.ndarray, mine: np.ndarray, link: np.ndarray, centres: np.ndarray, frames: np.ndarray,
    sizes: np.ndarray, boxes: np.ndarray, shares: np.ndarray, where: np.ndarray, push: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Middle (3,) [m] of what a finger touches the box with, as far in front as where it is nearest, and its half extents (3,) [m] along
    the box's axes, 1 in front.

    Args:
        shares, where: from ``gap_of``.
        others: as for it.
    """
    middle, extent, axes = np.zeros(3), np.zeros(3), np.empty((3, 3))
    for n in range(len(mine)):
        s, k = mine[n], link[mine[n]]
        if shares[n] > 0.0:
            x, y, z = _times(turns[k], centres[s, 0], centres[s, 1], centres[s, 2])
            for i, at in enumerate((x, y, z)):
                middle[i] += shares[n] * (at + shifts[k, i])
            _product(turns[k], frames[s], axes)
            for i in range(3):
                if boxes[s]:
                    reach = abs(axes[i, 0]) * sizes[s, 0] + abs(axes[i, 1]) * sizes[s, 1] + abs(axes[i, 2]) * sizes[s, 2]
                else:
                    reach = abs(axes[i, 2]) * sizes[s, 1] + sizes[s, 0]
                extent[i] += shares[n] * reach
    for i in range(3):
        if push[i] != 0.0:
            middle[i], extent[i] = where[i], 1.0
    return middle, extent


@numba.njit(cache=True, nogil=True)
def levers(
    joints: np.ndarray, finger_of: np.ndarray, sliding: np.ndarray, axes: np.ndarray, anchors: np.ndarray, tips: np.ndarray,
    shifts: np.ndarray, turns: np.ndarray, points: np.ndarray, push: np.ndarray,
) -> np.ndarray:
    """Torque (n,) [N m, N for a slide] on each finger joint per newton that its finger presses with.

    Args:
        joints: (n,) rows of ``axes`` and ``anchors`` (nj, 3), world.  finger_of: (n,).  sliding: (n,) bool.
        tips: (n_fingers,) rows of ``shifts`` (nb, 3) and ``turns`` (nb, 9) of the last links.
        points: (n_fingers, 3) from the last link's origin, in its axes.  push: (n_fingers, 3) towards the box.
    """
    out = np.empty(len(joints))
    for i in range(len(joints)):
        f, j = finger_of[i], joints[i]
        along = axes[j]
        if not sliding[i]:
            turn = turns[tips[f]].reshape(3, 3)
            arm = turn @ points[f] + shifts[tips[f]] - anchors[j]
            along = np.cross(axes[j], arm)
        out[i] = along[0] * push[f, 0] + along[1] * push[f, 1] + along[2] * push[f, 2]
    return out


@numba.njit(cache=True, nogil=True)
def held(
    residual: np.ndarray, solimp: np.ndarray, time: np.ndarray, inverse: np.ndarray, active: np.ndarray
) -> np.ndarray:
    """Forces (n,) of soft constraints at rest: a residual r is met by -r d^2 / (t^2 D^2 (1 - d) A).

    That is MuJoCo's static constraint force (computation, solver parameters): stiffness d / (D t)^2 over regularisation
    (1 - d) A / d, with impedance d(r) in ``solimp`` (n, 3+): at rest, displaced (D), width; ``time`` t and ``inverse`` inertia A.
    """
    out = np.zeros(len(residual))
    for i in range(len(residual)):
        if active[i]:
            low, top = solimp[i, 0], solimp[i, 1]
            share = min(abs(residual[i]) / solimp[i, 2], 1.0)
            d = low + (top - low) * (2.0 * share * share if share < 0.5 else 1.0 - 2.0 * (1.0 - share) ** 2)
            out[i] = -residual[i] * d * d / (top * top * time[i] * time[i] * (1.0 - d) * inverse[i])
    return out


@numba.njit(cache=True, nogil=True)
def meet(
    guess: np.ndarray, stay: np.ndarray, chain: np.ndarray, anchors: np.ndarray, axes: np.ndarray, sliding: np.ndarray,
    mine: np.ndarray, link: np.ndarray, centres: np.ndarray, frames: np.ndarray, sizes: np.ndarray, boxes: np.ndarray,
    active: np.ndarray, push: np.ndarray, origin: np.ndarray, half: np.ndarray, sideways: np.ndarray,
    pitching: np.ndarray, faces: np.ndarray, gap: float, height: float, minding: float, tilt: float,
    off: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """One finger near a guess: its gap, the height at which it presses and the lean of its pads as asked; without pads, its pitch.

    Args:
        guess: (n_all,) [rad, m].  stay: (n_all,) weights of the joints' departures from it, STAY for one that is free.
        sideways: (3,) the axis about which a pad pitches.  pitching: (n_all,) bool, joints that turn the pad.
        gap: [m] to the box.  height: [m], world, of its pressure.  tilt: [rad] of its pads' faces.
        off: (3,) place of that, from the middle of what it touches with, in half extents of that (``patch_of``).
        minding: share of their weight that height and tilt have.  faces: as for ``tilt_of``.
        others: as for ``place`` and ``gap_of``.

    Returns:
        angles (n,) of its joints; where it presses (3,), on its last link, at the start posture; how much it touches, 0 to 1; by how
        much (m, 3) [m] its pads are moved along their links, at the start posture, to come to the height that no joint brings them to.
    """
    count = len(chain)
    angles, change = guess.copy(), np.zeros(count)
    lower, upper = np.empty((count + 4, count)), np.empty(count + 4)
    weight, scale = np.empty(count), np.ones(count)
    for k in range(count):
        weight[k] = stay[chain[k]]
        if sliding[chain[k]]:
            scale[k] = SLIDE
    up = np.array([0.0, 0.0, 1.0])
    touches = 0.0  # a finger whose last shape vanishes has less and less to meet the box with
    for s in mine:
        touches = max(touches, active[s])
    for _ in range(ROUNDS):
        turns, shifts, now, at = place(angles, chain, anchors, axes, sliding)
        miss, where, shares, places = gap_of(turns, shifts, mine, link, centres, frames, sizes, boxes, active, push, origin, half)
        middle, extent = patch_of(turns, shifts, mine, link, centres, frames, sizes, boxes, shares, where, push)
        lower[:], upper[:] = 0.0, 0.0
        lean, part = tilt_of(turns, mine, link, frames, faces, shares, push, sideways)
        part *= minding * touches
        for k in range(count):
            slide = sliding[chain[k]]
            for n in range(len(mine)):
                if shares[n] > 1e-6 and k <= link[mine[n]]:
                    along = now[k] if slide else np.cross(now[k], places[n] - at[k])
                    lower[0, k] -= touches * GAP * shares[n] * (along @ push) / scale[k]
                    along = now[k] if slide else np.cross(now[k], middle - at[k])
                    lower[1, k] += touches * minding * HEIGHT * shares[n] * (along @ up) / scale[k]
            lower[2, k] = (1.0 - part) * PITCH * (now[k] @ sideways) if pitching[chain[k]] else 0.0
            lower[3, k] = 0.0 if slide else part * TILT * (now[k] @ sideways)
            lower[4 + k, k] = weight[k]
            upper[2] += lower[2, k] * change[k]
            upper[4 + k] = weight[k] * change[k]
        upper[3] = part * TILT * (lean - tilt)
        if miss < FAR:
            upper[0], upper[1] = touches * GAP * (miss - gap), touches * minding * HEIGHT * (middle[2] + extent[2] * off[2] - height)
        step = np.linalg.solve(lower.T @ lower, -(lower.T @ upper))
        largest = 0.0
        for k in range(count):
            largest = max(largest, abs(step[k]))
            change[k] += min(max(step[k], -STEP), STEP)
            angles[chain[k]] = guess[chain[k]] + change[k] / scale[k]
        if largest < ENOUGH:
            break
    turns, shifts, now, at = place(angles, chain, anchors, axes, sliding)
    miss, where, shares, _ = gap_of(turns, shifts, mine, link, centres, frames, sizes, boxes, active, push, origin, half)
    middle, extent = patch_of(turns, shifts, mine, link, centres, frames, sizes, boxes, shares, where, push)
    _, part = tilt_of(turns, mine, link, frames, faces, shares, push, sideways)
    slip, slips = 0.0, np.zeros((len(mine), 3))
    if miss < FAR:
        slip = part * minding * touches * min(max(height - middle[2] - extent[2] * off[2], -SLIP), SLIP)
        for n in range(len(mine)):
            if faces[mine[n]] >= 0:
                slips[n] = slip * (turns[link[mine[n]]].T @ up)
    middle[2] += slip
    return angles[chain], turns[count - 1].T @ (middle + extent * off - shifts[count - 1]), touches, slips
