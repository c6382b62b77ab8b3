"""view, morph, report, replay, doctor: looking at a run, at robots turning into robots, at what went wrong, at the installation."""

import os
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from toolkit.cli.names import TARGETS, TASK, find_robot, find_task, make_lab, transfer_config
from toolkit.cli.terminal import Progress, emit, room_for, table
from toolkit.errors import ToolkitError
from toolkit.io.quoting import told

if TYPE_CHECKING:
    import subprocess

    from toolkit.inspection.recording.layout import Layout
    from toolkit.inspection.recording.recordings import StoredRun
    from toolkit.simulation.laws import Drivable

STILLS, VIDEOS = (".png",), (".mp4", ".gif")
"""What the viewer saves, and what videos are written as."""
Page = Literal["evolution", "morph", "rollouts", "learning", "summary"]


def view(
    path: Annotated[tuple[Path, ...], tyro.conf.Positional] = (),
    rebuild: bool = False,
    live: bool = False,
    compare: tuple[str, ...] = (),
    seed: int = 10**9,
    page: Page | None = None,
    still: Path | None = None,
    at: float | None = None,
    size: str = "1600x1000",
    out: Path | None = None,
    video: Path | None = None,
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
        still: save what the viewer shows as a PNG instead of opening it, at the moment --at; of a run without --page the evolution.
        at: moment of the still or of the excerpt: seconds of the film, on the page learning the iteration; default: the last.
        size: of the still, WIDTHxHEIGHT.
        out: file for what --compare or --rebuild makes; default: inside the run folder. With --page, or --compare and --at:
            that page as it is at that moment, as a small recording of its own.
        video: write a run as a video that needs no viewer instead of opening it (MP4 or GIF).
    """
    if not path or len(path) > 2 or (len(path) == 2 and not compare):
        raise ToolkitError(f"view takes one run folder or .rrd file, and two run folders with --compare; got {len(path)}")
    if live:
        _follow(path[0])
        return
    from toolkit.inspection.recording import recordings, stream, viewer

    room_for(still, STILLS)
    if video is not None:
        print(f"{video}: {_film(path[0], video):.0f} s")
        return
    if still is not None and page is None and not compare and path[0].is_dir():
        page = "evolution"  # the tab that a run opens with
    frozen = (still or out) is not None and (page is not None or (compare and (at is not None or still is not None)))
    whole = None if frozen else out
    if compare:
        file, layout = _compare(path, compare, seed, whole)
    else:
        file = viewer.recording_of(_recording(path[0], rebuild, whole))
        layout = lambda excerpt: recordings.page_layout(_folder(path[0]), file, page, excerpt)  # noqa: E731
    if frozen:
        _freeze(file, "compare" if compare or page is None else page, at, layout, still, size, out)
    elif still is not None:
        viewer.still([file], still, _last(file, at), size)
    elif out is None:
        files = [file]
        known = (path[0] / "tree.json").is_file() and os.access(path[0], os.W_OK)
        if not compare and (page is not None or known):  # with what is known now of the run's curves
            files.append(_folder(path[0]) / f"{page or 'pages'}.rbl")
            layout(False).save(stream.APPLICATION, str(files[-1]))
        _open(*files)
        return
    print(still or out)


def _film(run: Path, video: Path, progress: Progress | None = None) -> float:
    """A run as a video; its length [s]."""
    room_for(video, VIDEOS)
    stored = stored_run(run)
    from toolkit.inspection.report.video import write_video

    with Progress("video", quiet=False) if progress is None else nullcontext(progress) as line:
        return write_video(run, stored.merged, stored.tree(), stored.policy, stored.native, video, lambda what: line.show("video", what))


def _last(file: Path, at: float | None) -> float | None:
    """``at``, or the last moment of a recording: where a picture is the same each time. None if it has no film."""
    from toolkit.inspection.recording import excerpt

    return excerpt.moment_of(file, at, "morph") or None


def _folder(path: Path) -> Path:
    """The run folder of a recording."""
    return path if path.is_dir() else path.parent


def _recording(path: Path, rebuild: bool, out: Path | None) -> Path:
    """A run folder or recording to be looked at; made first where that is asked for, or the only way."""
    if path.suffix == ".jsonl":
        from toolkit.inspection.recording.deployment import record_deployment

        return record_deployment(path)
    if not rebuild:
        return path
    from toolkit.inspection.recording import recordings
    from toolkit.io import claims

    file = out or path / "recording.rrd"
    stored = stored_run(path)
    if out is None:  # a running transfer writes that very file
        claims.claim(path, "look at it with --live, or give --out FILE")
    try:
        print(recordings.rebuild(stored, file))
    finally:
        claims.give_up(path)
    return file


def _compare(paths: tuple[Path, ...], targets: tuple[str, ...], seed: int, out: Path | None) -> "tuple[Path, Layout]":
    """A recording of policies side by side, and its layout."""
    from toolkit.inspection.recording import recordings

    sides = _sides(paths, targets)
    file = out or paths[0] / f"compare-{'-'.join(targets)}.rrd"
    trajectories, layout = recordings.compare(sides, file, seed)
    labels = [label for label, _, _ in sides]
    print("; ".join(f"{label}: {trajectory.verdict()}" for label, trajectory in zip(labels, trajectories, strict=True)))
    return file, layout


def _freeze(file: Path, page: str, at: float | None, layout: "Layout", still: Path | None, size: str, out: Path | None) -> None:
    """One page at one moment, as a recording of its own, as a picture, or both."""
    from toolkit.inspection.recording import excerpt, viewer

    moment = excerpt.moment_of(file, at, page)
    with TemporaryDirectory() as folder:
        cut = out or Path(folder) / f"{page}.rrd"
        excerpt.excerpt(file, page, moment, layout(True), cut)
        if still is not None:  # of the excerpt: there at once, and its curves have a cursor to show the moment
            moves = page in ("rollouts", "learning", "compare")
            viewer.still([cut], still, moment if moves else None, size, "iteration" if page == "learning" else "film")


def _open(*files: Path) -> None:
    """In a window, or served to a browser until Ctrl-C."""
    from toolkit.inspection.recording import viewer

    if viewer.has_display():
        viewer.open_window(*files)
        print(f"opened {files[0]} in the Rerun viewer")
    else:
        process, address, _ = _serve(*files)
        _wait(process, f"no display here; open {address} in a browser (from afar, forward its ports with ssh -L). Ctrl-C ends it.")


def _serve(*files: Path) -> "tuple[subprocess.Popen, str, str]":
    """As viewer.serve; a plain kill of this process is then as Ctrl-C, so that the server does not outlive it."""
    import signal

    from toolkit.inspection.recording import viewer

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    return viewer.serve(*files)


def _follow(folder: Path) -> None:
    """Show a transfer while it runs; it need not have begun."""
    if folder.exists():
        transfer_config(folder)
    try:
        _follow_running(_begun(folder))
    except KeyboardInterrupt:
        print("stopped looking; the transfer does not notice")


def _begun(folder: Path) -> "StoredRun":
    """A run as soon as its transfer has its tree."""
    import time

    from toolkit.inspection.recording.recordings import POLL

    waits = lambda: not (folder / "tree.json").exists() and not (folder / "report.json").exists()  # noqa: E731
    if waits():
        why = "it measures and merges its robots first" if folder.exists() else "there is no such run folder yet"
        print(f"waiting for the transfer of {folder} to begin: {why}", flush=True)
    while waits():
        time.sleep(POLL)
    return stored_run(folder)


def _follow_running(stored: "StoredRun") -> None:
    from toolkit.inspection.recording import recordings, viewer

    if viewer.has_display():
        process, proxy = viewer.follow_window()
        print("following the run in the Rerun viewer; close it, or Ctrl-C, to stop")
    else:
        process, address, proxy = _serve()
        print(f"no display here; open {address} in a browser. Ctrl-C ends it.", flush=True)
    try:
        recordings.follow(stored, proxy, until=lambda: process.poll() is not None)
        _wait(process, "the run has ended; Ctrl-C ends the viewer")
    finally:
        process.terminate()


def _wait(process: "subprocess.Popen", text: str) -> None:
    """Until the viewer is ended, by Ctrl-C or by its window; it is a failure if it ended otherwise."""
    print(text, flush=True)
    try:
        status = process.wait()
    except KeyboardInterrupt:
        process.terminate()
        return
    if status:
        raise ToolkitError(f"the viewer ended by itself with status {status}; see `meta-evolve doctor`")


def _sides(paths: tuple[Path, ...], targets: tuple[str, ...]) -> list[tuple[str, "StoredRun", str]]:
    """(label, run, target) of what is compared."""
    if len(targets) not in (1, 2) or len(paths) * len(targets) < 2:
        raise ToolkitError("compare two targets of a run (RUN --compare A B), or one target of two (RUN RUN --compare A)")
    pairs = [(paths[0], targets[0]), (paths[-1], targets[-1])]
    for path, name in pairs:
        known = transfer_config(path)["targets"]
        if name not in known:
            raise ToolkitError(f"target {name!r} is not in {path}; it has: {', '.join(known)}")
    every = [name for path in paths for name in transfer_config(path)["targets"]]
    merged = tuple(dict.fromkeys(every))
    stored = {path: stored_run(path, merged) for path in paths}
    labels = [name if len(paths) == 1 else f"{path.name}: {name}" for path, name in pairs]
    return [(label, stored[path], name) for label, (path, name) in zip(labels, pairs, strict=True)]


def stored_run(folder: Path, targets: tuple[str, ...] | None = None) -> "StoredRun":
    """A run folder with everything needed to play it again."""
    from toolkit.expert.shelf import POLICY_FILE, load_expert
    from toolkit.inspection.recording.recordings import StoredRun
    from toolkit.learning.policy import GaussianPolicy
    from toolkit.simulation.laws import native_plant

    content = transfer_config(folder)
    task = find_task(content["task"])
    lab = make_lab(content["source"], targets or content["targets"], content["task"])
    files = {name: folder / f"{name}{POLICY_FILE}" for name in content["targets"]}
    trained = {name: GaussianPolicy.load(file, task.observation.names, task.action.names) for name, file in files.items() if file.is_file()}
    policy, _ = load_expert(content["source"], task, content.get("expert"))

    def native(name: str) -> "Drivable":
        plant = native_plant(find_robot(name), task)
        if not content.get("randomise"):
            return plant
        from toolkit.evaluation.randomised import RandomisedRobot
        from toolkit.simulation.plant import Plant

        if not isinstance(plant, Plant):
            raise ToolkitError(f"{folder} says `randomise` of a task that has no such conditions; take it out of its config.json")
        return RandomisedRobot(plant, content["randomise"])

    return StoredRun(folder, lab.merged, policy, native, trained)


def morph(
    out: Path, source: str = "adroit", targets: tuple[str, ...] = TARGETS, task: str = TASK, still: Path | None = None,
    at: float | None = None, size: str = "1600x1000", lineup: Path | None = None,
) -> None:
    """Record the source turning into each target along the evolution tree, for the Rerun viewer; no policy is needed.

    Args:
        out: the .rrd file.
        source: the robot that turns.
        targets: what it turns into.
        task: what they do, or what lies on the table.
        still: also save a picture of it (PNG).
        at: moment of the still [s].
        size: of the still, WIDTHxHEIGHT.
        lineup: also draw the source and the targets side by side (PNG), for which no viewer is needed.
    """
    room_for(still, STILLS)
    room_for(lineup, STILLS)
    lab = make_lab(source, targets, task)
    from toolkit.inspection.recording import recordings, viewer

    recordings.morph(lab.merged, source, targets, out, lab.tree("l1", "steiner").to_json())
    if still is not None:
        viewer.still([out], still, _last(out, at), size)
    if lineup is not None:
        from toolkit.inspection.report.stills import line_up
        from toolkit.inspection.visual import visual_of

        line_up(visual_of(lab.merged), lab.space.names, lab.space.betas, lineup)
    print(f"{out}; look at it with: {told('view', out)}")


def report(
    run: Annotated[Path, tyro.conf.Positional], out: Path | None = None, video: Path | None = None, json: bool = False
) -> None:
    """Write a run's report for those without a viewer: one self-contained HTML page, and its pictures as PNGs.

    Tree, curves, table of targets, stills along each path, parameters, configuration. A run that goes on, or was stopped,
    gives a page too.

    Args:
        run: a run folder.
        out: folder of the page; default: RUN/page.
        video: also write the run as a video (MP4 or GIF).
        json: print the page's path and its pictures as one JSON object.
    """
    room_for(video, VIDEOS)
    stored = stored_run(run)
    from toolkit.inspection.report.page import write_report

    with Progress("report", quiet=json) as progress:
        page = write_report(run, stored.merged, stored.tree(), out, lambda what: progress.show("report", what, now=True))
        if video is not None:
            _film(run, video, progress)
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
    from toolkit.simulation.laws import merged_plant, native_plant
    from toolkit.simulation.osc import silence_warnings

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
            f"{row.torque:.0%}" if row.torque == row.torque else "none", " ".join(row.warnings)] for row in found.substeps])
    print(("Diverged again: " if found.diverged else "Did not diverge: ") + found.cause)


def doctor(json: bool = False) -> None:
    """Try what the toolkit needs of this machine, and say what to mend: versions, models, graphics, a still, room, permissions.

    Exit status 1 if it cannot work so; a warning is something that all but pictures do without.

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
