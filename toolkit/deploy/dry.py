"""A dry run: an arm's states through policy and safety, and nothing sent. Needs neither torch nor robosuite.

Each tick begins an episode of its own where the arm stands, because an arm that is sent nothing does not follow, and what holds it when
it does not would speak in every tick. What is told is therefore the first command of an episode, again and again, or why there is none.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from toolkit.bundle.manifest import Manifest
from toolkit.deploy.arm import ArmInfo, Command, State
from toolkit.deploy.runtime import Runtime
from toolkit.deploy.safety import Fault
from toolkit.errors import ToolkitError


class Listener(Protocol):
    """A driver that can be opened without anything that moves the arm."""

    def listen(self) -> ArmInfo:
        """As a driver's ``connect``, but open nothing that can move the arm."""

    def read(self) -> State:
        """As a driver's."""


@dataclass(frozen=True, eq=False)
class Seen:
    """One tick of a dry run.

    Attributes:
        state: measured; None: it could not be read.
        fault: why nothing would be sent; None: ``command`` would be.
        command: that would be sent, in the driver's order of joints; None with a fault.
        action: the policy's (n_act,); empty where it was not asked.
        tick_ms: the runtime's own time.
    """

    state: State | None
    fault: Fault | None
    command: Command | None = None
    action: np.ndarray = field(default_factory=lambda: np.zeros(0))
    tick_ms: float = 0.0


def nominal_scene(manifest: Manifest) -> Callable[[], tuple[np.ndarray, np.ndarray, np.ndarray, float]]:
    """Where a bundle's object and goal are at the start of an episode, noise left out: a scene without cameras, for dry runs alone."""
    task = manifest.task
    half = np.ravel(task.object.get("half_size_m", [0.0]))
    place = np.array([*task.object_xy_m, task.table_top_m + float(half[-1])])
    goal = place + np.array(task.goal_offset_m)
    return lambda: (place.copy(), np.array([1.0, 0.0, 0.0, 0.0]), goal.copy(), time.monotonic())


def nominal_opening(manifest: Manifest) -> float:
    """Opening, 0 to 1, of a bundle's gripper at its preshape."""
    gripper = manifest.gripper
    return float(np.interp(gripper.preshape, gripper.command, gripper.opening_m)) / gripper.opening_m[0]


def dry_run(runtime: Runtime, driver: Listener, ticks: int, sleep: Callable[[float], None] = time.sleep) -> Iterator[Seen]:
    """Read, decide, limit, tell; once per policy period. The driver is only ever read.

    Args:
        runtime: of the bundle, for the ArmInfo that ``driver.listen()`` gave.
        driver: listening.
        ticks: how many.
        sleep: waits so many seconds.
    """
    due = time.monotonic()
    for _ in range(ticks):
        yield _look(runtime, driver)
        due = max(due + runtime.period, time.monotonic())
        sleep(max(0.0, due - time.monotonic()))


def _look(runtime: Runtime, driver: Listener) -> Seen:
    try:
        state = driver.read()
    except (OSError, ToolkitError, RuntimeError) as error:
        return Seen(None, Fault("driver", f"the state could not be read ({error})"))
    began = time.perf_counter()
    fault = runtime.begin(state, time.monotonic())
    if fault is not None:
        return Seen(state, fault, tick_ms=1e3 * (time.perf_counter() - began))
    tick = runtime.tick(state, time.monotonic())
    spent = 1e3 * (time.perf_counter() - began)
    return Seen(state, tick.fault, None if tick.fault else tick.command, tick.action, spent)


def tally(seen: list[Seen]) -> dict[str, int]:
    """Kind of fault -> ticks; the ticks that would send are under "would_send"."""
    return dict(Counter(tick.fault.kind if tick.fault else "would_send" for tick in seen))
