"""The geometric median: the one meta robot of the paper's baseline (section "Baselines")."""

import numpy as np

from toolkit.evolution.geometry import TIE, distinct_points


def median_l1(points: np.ndarray) -> np.ndarray:
    """Coordinate-wise median (D,) of points (n, D); of an interval of equally good values, the one nearest to the source's."""
    ranked = np.sort(points, axis=0)
    return np.clip(points[0], ranked[(len(points) - 1) // 2], ranked[len(points) // 2])


def median_l2(points: np.ndarray) -> np.ndarray:
    """The point (D,) of least summed Euclidean distance to points (n, D).

    A point of the set is tested first: no other can pull the median off it if the summed unit pulls do not exceed its own weight
    (Vardi and Zhang, PNAS 2000). Else the median is smooth, and Newton's method on the star converges from their mean.
    """
    distinct, twin = distinct_points(points)
    count = np.bincount(twin, minlength=len(points))[distinct].astype(float)
    stars = points[distinct]
    for index, here in enumerate(stars):
        away = stars - here
        radius = np.linalg.norm(away, axis=1)
        radius[index] = 1.0
        if np.linalg.norm((count / radius) @ away) <= count[index] * (1 + TIE):
            return here
    return _smooth_median(stars, count)


def _smooth_median(stars: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Newton's method on the summed distance, in the stars' span, with steps halved until the sum falls."""
    origin = stars[0]
    _, size, axes = np.linalg.svd(stars - origin, full_matrices=False)
    axes = axes[size > 1e-14 * size[0]]
    flat = (stars - origin) @ axes.T
    length = lambda x: float(count @ np.linalg.norm(flat - x, axis=1))  # noqa: E731
    x = np.average(flat, axis=0, weights=count)
    for _ in range(100):
        away = x - flat
        radius = np.maximum(np.linalg.norm(away, axis=1), 1e-15)
        unit = away / radius[:, None]
        gradient = count @ unit
        stiffness = count / radius
        newton = np.linalg.solve(stiffness.sum() * np.eye(x.size) - (unit * stiffness[:, None]).T @ unit, gradient)
        step, now = 1.0, length(x)
        while length(x - step * newton) > now - 1e-4 * step * float(gradient @ newton) and step > 1e-9:
            step /= 2
        if step <= 1e-9:
            break
        x = x - step * newton
        if np.linalg.norm(step * newton) <= 1e-15 * np.ptp(flat):
            break
    return origin + x @ axes
