"""deploy --dry-run: what would be sent to an arm, and nothing sent."""

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from toolkit.cli.terminal import emit
from toolkit.errors import ToolkitError

if TYPE_CHECKING:
    from toolkit.bundle.reading import Bundle
    from toolkit.deploy.arm import ArmInfo
    from toolkit.deploy.drivers.sim import SimDriver
    from toolkit.deploy.dry import Listener, Seen
    from toolkit.deploy.runtime import Form

ACCOUNT = "META_EVOLVE_KORTEX_ACCOUNT"
"""USER:PASSWORD on a Gen3: on a command line everybody on the machine could read it."""
ASSUMED = {
    "ur": "no camera and no gripper are read: the object is taken to lie where episodes start, the gripper to stand at its preshape",
    "franka": "no camera is read: the object is taken to lie where episodes start",
    "kortex": "no camera is read: the object is taken to lie where episodes start",
    "ros2": "no camera and no gripper are read: the object is taken to lie where episodes start, the gripper to stand at its preshape",
}
"""Driver -> what a dry run from the command line does not know."""


def dry(bundle: "Bundle", driver: str, arm: "Listener", close: Callable[[], None], form: "Form", ticks: int, json: bool) -> None:
    """Listen to an arm for a few ticks, and print what would have been sent to it.

    Args:
        bundle: of the arm.
        driver: its name.
        arm, close: of ``listener``.
        form: of the commands.
        ticks: how many, at least one.
        json: print one JSON object.
    """
    from toolkit.deploy.dry import dry_run, tally
    from toolkit.deploy.runtime import Runtime

    seen: list[Seen] = []
    try:
        info = arm.listen()
        for tick in dry_run(Runtime(bundle, info, form), arm, ticks):
            seen.append(tick)
            if not json:
                print(_line(len(seen), tick), flush=True)
    finally:
        close()
    emit(_content(bundle, driver, form, info.joints, seen, tally(seen)), json, _summary(bundle, driver, info.joints, seen, tally(seen)))


def listener(bundle: "Bundle", driver: str, host: str | None) -> tuple["Listener", Callable[[], None]]:
    """A driver with nothing around it that could move the arm, not yet listening, and what closes it.

    Raises:
        ToolkitError: an address or an account is missing.
    """
    from toolkit.deploy.dry import nominal_opening, nominal_scene

    manifest = bundle.manifest
    name, joints, scene = manifest.robot.name, [joint.name for joint in manifest.joints], nominal_scene(manifest)
    opening = nominal_opening(manifest)
    if driver == "ros2":
        from toolkit.deploy.drivers.ros2 import open_arm

        return open_arm(name, joints, scene, opening=lambda: opening, listens=True)
    if not host:
        raise ToolkitError(f"--driver {driver} needs the arm's address; give --host")
    if driver == "ur":
        from toolkit.deploy.drivers.ur import UniversalRobots

        return UniversalRobots(host, name, joints, scene, lambda *to: None, lambda: opening), lambda: None
    if driver == "franka":
        from toolkit.deploy.drivers.franka import Franka

        return Franka(host, name, joints, scene, manifest.gripper.opening_m[0]), lambda: None
    from toolkit.deploy.drivers.kortex import Kortex

    user, found, password = os.environ.get(ACCOUNT, "").partition(":")
    if not found:
        raise ToolkitError(f"a Gen3 asks for user and password; set {ACCOUNT} to USER:PASSWORD")
    arm = Kortex(host, name, joints, scene, (user, password))
    return arm, lambda: arm.stop("the dry run is over")  # ends the session; the arm, which was never fed, is told nothing


class ListenedTwin:
    """A twin as an arm that is only read.

    Args:
        arm: driver of a twin.
        seed: of the start at which it stands.
    """

    def __init__(self, arm: "SimDriver", seed: int) -> None:
        self._arm, self._seed, self.read = arm, seed, arm.read

    def listen(self) -> "ArmInfo":
        """See Listener; the simulated robot is put at its start, which no real arm can be."""
        info = self._arm.connect()
        self._arm.begin(self._seed)
        return info


def _line(number: int, tick: "Seen") -> str:
    """One tick for people."""
    if tick.command is None:
        return f"tick {number}: nothing: {tick.fault.kind}: {tick.fault.detail}" if tick.fault else f"tick {number}: nothing"
    target = " ".join(f"{value:.4f}" for value in tick.command.target)
    opening = f"opening {tick.command.opening:.3f} ({1e3 * tick.command.opening_m:.1f} mm)"
    return f"tick {number}: would send {tick.command.form} {target}, {opening}"


def _content(
    bundle: "Bundle", driver: str, form: "Form", joints: tuple[str, ...], seen: list["Seen"], counts: dict[str, int]
) -> dict[str, Any]:
    """What ``deploy --dry-run --json`` prints."""
    last = seen[-1]
    times = np.percentile([tick.tick_ms for tick in seen], [50, 99, 100]).tolist()
    return {
        "driver": driver, "dry_run": True, "target": bundle.manifest.robot.name, "form": form, "ticks": len(seen), "sent": 0,
        "would_send": counts.get("would_send", 0), "faults": {kind: n for kind, n in counts.items() if kind != "would_send"},
        "joints": list(joints), "measured": None if last.state is None else [float(v) for v in last.state.joints],
        "command": None if last.command is None else last.command.target.tolist(), "fault": last.fault.detail if last.fault else None,
        "tick_ms": dict(zip(("p50", "p99", "max"), times, strict=True)), "assumed": ASSUMED.get(driver),
    }


def _summary(bundle: "Bundle", driver: str, joints: tuple[str, ...], seen: list["Seen"], counts: dict[str, int]) -> str:
    """The end for people: the joints by name, to be compared with the teach pendant, and the tally."""
    lines, last = [], seen[-1]
    if last.state is not None and len(last.state.joints) == len(joints):
        start = dict(zip((joint.name for joint in bundle.manifest.joints), bundle.manifest.start.arm_rad, strict=True))
        lines += [f"{name}: {angle:.4f} rad, {np.degrees(angle):.1f} degrees; episodes start at {start[name]:.4f}"
                  for name, angle in zip(joints, np.asarray(last.state.joints, float), strict=True)]
    held = ", ".join(f"{kind} {count}" for kind, count in counts.items() if kind != "would_send") or "none"
    lines.append(f"{driver}, dry run: {len(seen)} ticks, nothing sent; {counts.get('would_send', 0)} would have been, held for: {held}")
    if driver in ASSUMED:
        lines.append(ASSUMED[driver])
    return "\n".join(lines)
