"""view, morph, report, replay, doctor: looking at a run, at robots turning into robots, at what went wrong, at the installation."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from toolkit.cli.names import TARGETS, TASK, find_robot, find_task, make_lab
from toolkit.cli.terminal import Progress, emit, table
from toolkit.errors import ToolkitError

if TYPE_CHECKING:
    import subprocess

    from toolkit.recording.shows import Known

Page = Literal["evolution", "morph", "rollouts", "learning", "summary"]


def view(
    path: Annotated[tuple[Path, ...], tyro.conf.Positional],
    rebuild: bool = False,
    live: bool = False,
    compare: tuple[str, ...] = (),
    seed: int = 10**9,
    page: Page | None = None,
    still: Path | None = None,
    at: float | None = None,
    size: str = "1600x1000",
    out: Path | None = None,
) -> None:
    """Look at a run in the Rerun viewer: evolution, morph, rollouts, learning, summary, each a tab.

    With a display a window opens; without one the viewer is served to a browser and its address printed. On the timeline
    "film" the run plays as one film: the robot turns into the next one, then plays the episodes worth seeing.

    Args:
        path: a run folder, an .rrd file, or the .jsonl log of a deployment; with --compare one or two run folders.
        rebuild: make the recording anew from the run folder, with every episode that its phases hold.
        live: follow a running transfer; it may also be still to begin.
        compare: one or two targets, or one target of two runs: their final policies side by side, from the same seed.
        seed: of the start in --compare; the default is the first of `meta-evolve evaluate`.
        page: show this page alone.
        still: save what the viewer shows as a PNG instead of opening it.
        at: moment of the still or of the excerpt: seconds of the film, on the page learning the iteration.
        size: of the still, WIDTHxHEIGHT.
        out: file for what --compare or --rebuild makes; default: inside the run folder. With --page, or --compare and --at:
            that page as it is at that moment (default: the last), as a small recording of its own.
    """
    from toolkit.recording import excerpt, shows, stream, viewer

    if len(path) == 1 and path[0].suffix == ".jsonl":
        from toolkit.recording.deployment import record_deployment

        path = (record_deployment(path[0]),)
    if not path or len(path) > 2 or (len(path) == 2 and not compare):
        raise ToolkitError(f"view takes one run folder or .rrd file, and two run folders with --compare; got {len(path)}")
    if live:
        _follow(path[0])
        return
    file = path[0]
    if compare:
        cut = out if at is not None and still is None else None
        file = path[0] / f"compare-{'-'.join(compare)}.rrd" if cut or out is None else out
        sides = _sides(path, compare)
        films = shows.compare(sides, file, seed)
        print("; ".join(f"{label}: {film.verdict()}" for (label, _, _), film in zip(sides, films, strict=True)))
        if cut is not None:
            excerpt.excerpt(file, "compare", at, shows.compare_layout([label for label, _, _ in sides], True), cut)
    elif rebuild:
        file = out if out is not None and page is None else path[0] / "recording.rrd"
        print(str(shows.rebuild(_known(path[0]), file)))
    file = viewer.recording_of(file)
    files = [file]
    alone = page is not None and not compare
    if alone and (still or out):
        with TemporaryDirectory() as folder:
            moment = excerpt.moment_of(file, at, page)
            cut = out or Path(folder) / f"{page}.rrd"
            excerpt.excerpt(file, page, moment, shows.page_layout(_folder(path[0]), file, page, True), cut)
            if still is not None:  # of the excerpt: there at once, and its curves have a cursor to show the moment
                moves = page in ("rollouts", "learning")
                viewer.still([cut], still, moment if moves else None, size, "iteration" if page == "learning" else "film")
        print(still or out)
        return
    if alone:
        files.append(_folder(path[0]) / f"{page}.rbl")
        shows.page_layout(files[-1].parent, file, page).save(stream.APPLICATION, str(files[-1]))
    if still is not None:
        viewer.still(files, still, at, size)
        print(still)
    elif out is not None:
        print(out)
    elif viewer.has_display():
        viewer.open_window(*files)
        print(f"opened {file} in the Rerun viewer")
    else:
        process, address, _ = viewer.serve(*files)
        _wait(process, f"no display here; open {address} in a browser (from afar, forward its ports with ssh -L). Ctrl-C ends it.")


def _folder(path: Path) -> Path:
    """The run folder of a recording."""
    return path if path.is_dir() else path.parent


def _follow(folder: Path) -> None:
    import time

    from toolkit.recording import shows, viewer

    _content(folder)
    waits = lambda: not (folder / "tree.json").exists() and not (folder / "report.json").exists()  # noqa: E731
    if waits():
        print("waiting for the transfer to begin: it measures and merges its robots first", flush=True)
    while waits():
        time.sleep(shows.POLL)
    known = _known(folder)
    if viewer.has_display():
        process, proxy = viewer.follow_window()
        print("following the run in the Rerun viewer; close it, or Ctrl-C, to stop")
    else:
        process, address, proxy = viewer.serve()
        print(f"no display here; open {address} in a browser. Ctrl-C ends it.", flush=True)
    try:
        shows.follow(known, proxy, until=lambda: process.poll() is not None)
        _wait(process, "the run has ended; Ctrl-C ends the viewer")
    except KeyboardInterrupt:
        print("stopped looking; the transfer does not notice")
    finally:
        process.terminate()


def _wait(process: "subprocess.Popen", text: str) -> None:
    print(text, flush=True)
    try:
        process.wait()
    except KeyboardInterrupt:
        process.terminate()


def _sides(paths: tuple[Path, ...], targets: tuple[str, ...]) -> list[tuple[str, "Known", str]]:
    """(label, run, target) of what is compared."""
    if len(targets) not in (1, 2) or len(paths) * len(targets) < 2:
        raise ToolkitError("compare two targets of a run (RUN --compare A B), or one target of two (RUN RUN --compare A)")
    pairs = [(paths[0], targets[0]), (paths[-1], targets[-1])]
    every = [name for path in paths for name in _content(path)["targets"]]
    merged = tuple(dict.fromkeys(every))
    known = {path: _known(path, merged) for path in paths}
    labels = [name if len(paths) == 1 else f"{path.name}: {name}" for path, name in pairs]
    return [(label, known[path], name) for label, (path, name) in zip(labels, pairs, strict=True)]


def _content(folder: Path) -> dict:
    from toolkit.runs import Run

    content = Run.open(folder).config
    missing = [key for key in ("source", "targets", "task") if key not in content]
    if missing:
        raise ToolkitError(f"{folder / 'config.json'} has no {missing[0]!r}, so it is no transfer's run folder")
    return content


def _known(folder: Path, targets: tuple[str, ...] | None = None) -> "Known":
    """A run folder with everything needed to play it again."""
    from tasks.pick import ACTION, OBSERVATION
    from toolkit.expert import entry_names, load_expert
    from toolkit.learning.policy import GaussianPolicy
    from toolkit.recording.shows import Known
    from toolkit.simulation.plant import native_plant

    content = _content(folder)
    task = find_task(content["task"])
    lab = make_lab(content["source"], targets or content["targets"], content["task"])
    files = {name: folder / f"{name}.policy.safetensors" for name in content["targets"]}
    names = entry_names(OBSERVATION), entry_names(ACTION)
    trained = {name: GaussianPolicy.load(file, *names) for name, file in files.items() if file.is_file()}
    policy, _ = load_expert(content["source"], content["task"], content.get("expert"))
    return Known(folder, lab.merged, policy, lambda name: native_plant(find_robot(name), task), trained)


def morph(
    out: Path, source: str = "adroit", targets: tuple[str, ...] = TARGETS, task: str = TASK, still: Path | None = None,
    at: float | None = None, size: str = "1600x1000",
) -> None:  # fmt: skip
    """Record the source turning into each target along the evolution tree, for the Rerun viewer; no policy is needed.

    Args:
        out: the .rrd file.
        source: the robot that turns.
        targets: what it turns into.
        task: what lies on the table.
        still: also save a picture of it (PNG).
        at: moment of the still [s].
        size: of the still, WIDTHxHEIGHT.
    """
    lab = make_lab(source, targets, task)
    from toolkit.recording import shows, viewer

    shows.morph(lab.merged, source, targets, out, lab.tree("l1", "steiner").to_json())
    if still is not None:
        viewer.still([out], still, at, size)
    print(f"{out}; look at it with: meta-evolve view {out}")


def report(run: Annotated[Path, tyro.conf.Positional], out: Path | None = None, json: bool = False) -> None:
    """Write a run's report for those without a viewer: one self-contained HTML page, and its pictures as PNGs.

    Tree, curves, table of targets, stills along each path, parameters, configuration. A run that goes on, or was stopped,
    gives a page too.

    Args:
        run: a run folder.
        out: folder of the page; default: RUN/page.
        json: print the page's path and its pictures as one JSON object.
    """
    known = _known(run)
    from toolkit.report.page import write_report

    with Progress("report", quiet=json) as progress:
        page = write_report(run, known.merged, known.tree(), out, lambda what: progress.show("report", what, now=True))
    pictures = sorted(str(file) for file in page.parent.glob("*.png"))
    emit({"page": str(page), "pictures": pictures}, json, f"{page}, and {len(pictures)} pictures beside it")


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
