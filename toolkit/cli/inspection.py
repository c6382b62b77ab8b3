"""view, replay, doctor: looking at a run, at what went wrong in it, and at the installation."""

from pathlib import Path
from typing import Annotated

import tyro

from toolkit.cli.names import find_robot, find_task, make_lab
from toolkit.cli.terminal import emit, table


def view(path: Annotated[Path, tyro.conf.Positional]) -> None:
    """Open a run's recording in the Rerun viewer.

    Args:
        path: a run folder or an .rrd file.
    """
    from toolkit.recording import show

    print(show(path))


def replay(file: Annotated[Path, tyro.conf.Positional], json: bool = False) -> None:
    """Play the policy step again in which a simulation blew up: what diverged, where and when.

    The first such step of every run lies in <run>/divergence.npz: its robot, state and actions.

    Args:
        file: the dump.
        json: print one JSON object.
    """
    from toolkit.simulation.divergence import Divergence
    from toolkit.simulation.divergence import replay as play_again
    from toolkit.simulation.osc import silence_warnings
    from toolkit.simulation.plant import merged_plant, native_plant

    dump = Divergence.load(file)
    robots, task = [find_robot(name) for name in dump.robots], find_task(dump.task)
    silence_warnings()
    if dump.native:
        plant = native_plant(robots[0], task)
    else:
        merged = make_lab(dump.robots[0], dump.robots[1:], dump.task).merged
        plant = merged_plant(merged, dump.alpha, *merged.new())
    found = play_again(plant, dump)
    content = {"robots": list(dump.robots), "native": dump.native, "task": dump.task, "seed": dump.seed, "step": dump.step}
    if json:
        emit(content | found.to_json(), True, "")
        return
    kind = "the unmodified robot" if dump.native else "the merged robot of"
    table(f"{kind} {', '.join(dump.robots)}, {dump.task}, seed {dump.seed}, policy step {dump.step}",
          ["time [s]", "fastest joint", "speed", "contacts", "deepest [mm]", "torque of limit", "warnings"],
          [[f"{row.time:.3f}", row.joint, f"{row.speed:.3g}", row.contacts, f"{1000 * row.penetration:.2f}",
            f"{row.torque:.0%}" if row.torque == row.torque else "none", " ".join(row.warnings)] for row in found.substeps])  # fmt: skip
    print(("Diverged again: " if found.diverged else "Did not diverge: ") + found.cause)


def doctor(json: bool = False) -> None:
    """Check versions, models, rendering and Rerun, and say what to mend.

    Args:
        json: print one JSON object.
    """
    from toolkit.doctor import checks

    found = checks()
    if json:
        emit({"checks": [c._asdict() for c in found]}, True, "")
    else:
        marks = {True: "ok", False: "BROKEN", None: "warning"}
        table("Doctor", ["check", "", "found", "mend"], [[c.name, marks[c.ok], c.detail, "" if c.ok else c.mend] for c in found])
    if any(c.ok is False for c in found):
        raise SystemExit(1)
