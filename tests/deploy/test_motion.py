"""The limiter leaves no limit whatever is wished, and a commanded metre is the metre that the arm would make."""

import numpy as np

from toolkit.deploy.kinematics import Kinematics
from toolkit.deploy.motion import Expected, Track

ROUNDING = 1e-9


def test_a_track_never_leaves_its_limits_in_a_million_ticks():
    """1000 coordinates with limits of their own, 1000 ticks of adversarial wishes; checked between ticks, too."""
    rng = np.random.default_rng(0)
    n, period = 1000, 0.05
    low = rng.uniform(-3, 0, n)
    high = low + 10.0 ** rng.uniform(-3, 1, n)
    speed, push = 10.0 ** rng.uniform(-2, 1, n), 10.0 ** rng.uniform(-1, 2, n)
    low[::7], high[::11] = -np.inf, np.inf
    track = Track(low, high, speed, push, period)
    track.begin(rng.uniform(np.maximum(low, -3), np.minimum(high, 10)))
    mood = rng.uniform(-1, 1, n)
    for tick in range(1000):
        if tick % 20 == 0:
            mood = rng.choice([-1.0, 0.0, 1.0], n)
        wanted = np.where(rng.random(n) < 0.2, rng.choice([np.nan, np.inf, -np.inf, 1e30, 0.0], n), mood * 2 * speed * rng.random(n))
        place, rate = track.place, track.rate
        track.advance(wanted)
        assert np.isfinite(track.place).all() and np.isfinite(track.rate).all()
        assert (np.abs(track.rate) <= speed * (1 + ROUNDING)).all()
        assert (np.abs(track.rate - rate) <= push * period * (1 + 1e-6) + ROUNDING).all(), "acceleration"
        between = track.waypoints(place, rate, 5)
        assert ((between >= low - ROUNDING) & (between <= high + ROUNDING)).all(), "left its limits"
        moved = place + 0.5 * period * (rate + track.rate)
        assert np.abs(moved - track.place).max() < 1e-7, "a clip hid that braking came too late"
        np.testing.assert_allclose(between[-1], track.place, atol=1e-9)


def test_a_track_reaches_what_it_is_asked_for():
    """A steady wish inside the limits comes true: the limiter does not creep."""
    rng, n, period = np.random.default_rng(1), 500, 0.05
    speed, push, room = 10.0 ** rng.uniform(-2, 1, n), 10.0 ** rng.uniform(-1, 2, n), 10.0 ** rng.uniform(-2, 1, n)
    track = Track(np.zeros(n), room, speed, push, period)
    track.begin(0.5 * room)
    goal = room * rng.uniform(0.02, 0.98, n)
    for _ in range(int((20 * (room / speed + 2 * np.sqrt(room / push) + speed / push)).max()) + 400):
        track.advance(0.5 * (goal - track.place) / period)
    assert (np.abs(track.place - goal) <= np.maximum(1e-3 * room, 3 * push * period**2)).all()


def test_the_response_foretells_the_recorded_motion(bundle):
    """Summed impulse responses of the recorded actions, without any feedback, against where the recorded arm went over two
    seconds: within 5 cm, where deltas taken for displacements are off by more than eight times that."""
    g, m = bundle.golden, bundle.manifest
    kinematics = Kinematics.of(m, bundle.mjcf)
    expected, place, naive = Expected(m), None, None
    worst, worst_naive = np.zeros(6), 0.0
    for joints, fingers, action in zip(g["episode_joints"], g["episode_fingers"], g["episode_actions"], strict=True):
        kinematics.place(joints, fingers)
        here = kinematics.coordinates()
        place, naive = (here, here) if place is None else (place, naive)
        worst, worst_naive = np.maximum(worst, np.abs(place - here)), max(worst_naive, np.abs(naive - here)[:3].max())
        place = place + expected.step(action[:6])
        naive = naive + action[:6] * expected.scale
    assert worst[:3].max() < 0.05, f"{worst[:3]} m"
    assert worst_naive > 8 * worst[:3].max(), f"naive {worst_naive} m, foretold {worst[:3].max()} m"
