"""The direction of the next step of evolution: HERD's path optimisation (Algorithm 1, line 4; eq. herd:objective).

    max over |l|_2 = xi of   E[rho(pi, F(alpha + l))] - lambda / 2 |beta_meta - (alpha + l)|_2^2

To first order in l the best step is xi times the unit vector along J + lambda (beta_meta - alpha), with J the Jacobian of the
expected discounted return over the evolution parameters. J is estimated from episodes on robots sampled around alpha.
The straight path of REvolveR is the same with J = 0.

The pull is Euclidean whatever the tree's metric, as in HERD: the gradient of a squared L1 distance is sqrt(D) times that
distance long, next to which no return between 0 and 1 has a say.
"""

import numpy as np

TRUST = 0.8
"""The return's part of the direction is cut to this share of the pull's. An estimate from a few dozen episodes is mostly
noise that does not shrink towards the meta robot as the pull does: uncut, the walk would circle there for ever. Cut,
every step of length xi comes at least sqrt(1 - TRUST^2) xi = 0.6 xi nearer, to first order."""


def sample_robots(alpha: np.ndarray, count: int, radius: float, rng: np.random.Generator) -> np.ndarray:
    """Robots around ``alpha`` (D,) in antithetic pairs: alpha + d and alpha - d, each clipped to the box [0, 1].

    Returns:
        (count, D) with pairs in rows 2i and 2i + 1; directions d are uniform on the sphere of ``radius``.
    """
    directions = rng.standard_normal((-(-count // 2), alpha.size))
    directions *= radius / np.linalg.norm(directions, axis=1, keepdims=True)
    pairs = np.stack([directions, -directions], axis=1).reshape(-1, alpha.size)
    return np.clip(alpha + pairs[:count], 0.0, 1.0)


def jacobian(robots: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """Jacobian (D,) of the expected return from paired samples: the least-squares fit of least norm.

    Both robots of a pair play the same seed, so a pair tells by the difference of its returns only; what the seed itself
    is worth falls out with the pair's mean. A last robot without partner says nothing.

    Args:
        robots: (count, D) as `sample_robots` made them.
        returns: (count,) what each earned.
    """
    even = len(robots) // 2 * 2
    steps = robots[0:even:2] - robots[1:even:2]
    gains = returns[0:even:2] - returns[1:even:2]
    return np.linalg.lstsq(steps, gains, rcond=None)[0]


def heading(slope: np.ndarray, alpha: np.ndarray, meta: np.ndarray, weight: float) -> np.ndarray:
    """Unit vector (D,) of the next step.

    Args:
        slope: (D,) Jacobian of the expected return; zero for the straight path.
        alpha, meta: (D,) current robot and meta robot; not the same.
        weight: lambda, above 0.
    """
    pull = weight * (meta - alpha)
    limit = TRUST * np.linalg.norm(pull)
    size = np.linalg.norm(slope)
    direction = pull + (slope if size <= limit else slope * (limit / size))
    return direction / np.linalg.norm(direction)
