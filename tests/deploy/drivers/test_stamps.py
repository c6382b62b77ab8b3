"""A state is as old as its device says."""

from types import SimpleNamespace

import numpy as np
import pytest

from toolkit.deploy.drivers.stamps import Changes, DeviceClock


def test_a_devices_clock_is_set_by_its_quickest_packet_and_stands_still_with_it():
    now = SimpleNamespace(at=100.0)
    clock = DeviceClock(lambda: now.at)
    assert clock(5.0) == pytest.approx(100.0)
    now.at = 100.25
    assert clock(5.1) == pytest.approx(100.1, abs=1e-3), "150 ms on its way"
    now.at = 100.6
    assert clock(5.1) == pytest.approx(100.1, abs=1e-3), "dead"
    clock, ages = DeviceClock(lambda: now.at), []
    for tick in range(20 * 600):  # ten minutes on a clock that is 200 ppm slow, with packets of 2 to 20 ms
        now.at = 101.0 + 0.05 * tick
        ages.append(now.at - clock(0.1 + (0.05 * tick - 0.002 - 0.018 * (tick % 7) / 6) * (1 - 2e-4)))
    assert 0.0 <= min(ages) and max(ages[20:]) < 0.035, f"{min(ages):.4f} to {max(ages[20:]):.4f} s"


def test_a_device_that_puts_its_clock_on_or_back_is_not_believed():
    """Otherwise a packet from the past, or a controller that has started again in the midst of an episode, would pass for fresh."""
    now = SimpleNamespace(at=100.0)
    clock = DeviceClock(lambda: now.at)
    for tick in range(30):
        now.at = 100.0 + 0.05 * tick
        assert clock(5.0 + 0.05 * tick) == pytest.approx(now.at, abs=1e-3)
    now.at += 0.05
    assert now.at - clock(0.3) > 5, "started again: old until the driver connects anew"
    assert now.at - clock(5.5) == pytest.approx(1.0, abs=1e-2), "a packet out of its order"
    assert clock(7.5) - now.at == pytest.approx(1.0, abs=1e-2), "in the future: no packet comes before it was measured"
    assert clock(6.5) == pytest.approx(now.at, abs=1e-2), "and all is well again"
    assert np.isnan(clock(float("nan")))
    late = DeviceClock(lambda: now.at)
    late(5.0)
    now.at += 0.05
    assert late(5.5) == pytest.approx(now.at), "the first packets may have waited longer than those that follow"
    now.at += 600.0
    assert late(605.62) == pytest.approx(now.at), "ten minutes between two episodes on a clock that is 200 ppm fast"


def test_a_state_that_does_not_change_grows_old():
    now = SimpleNamespace(at=1.0)
    changed = Changes(lambda: now.at)
    assert changed((1, 2)) == 1.0
    now.at = 2.0
    assert changed((1, 2)) == 1.0 and changed((1, 3)) == 2.0
