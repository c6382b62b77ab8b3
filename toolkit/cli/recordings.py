"""recordings make, list, retarget: the commands on recordings of hands."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from toolkit.cli.help import helped
from toolkit.cli.names import find_arm
from toolkit.cli.terminal import Progress, emit, table
from toolkit.errors import ToolkitError
from toolkit.io.quoting import told

if TYPE_CHECKING:
    from toolkit.demonstrations.replay import Demonstration, Retargeter

recordings = tyro.extras.SubcommandApp()


@recordings.command
@helped
def make(
    out: Annotated[Path, tyro.conf.Positional],
    objects: tuple[str, ...] = (),
    each: int = 5,
    frames: int = 42,
    seed: int = 0,
    json: bool = False,
) -> None:
    """Write a stand-in for DexYCB: synthetic hands that pick YCB objects, in DexYCB's own format.

    Nothing in it was recorded. It is for everyone who has no DexYCB, and for tests.

    Args:
        out: a folder that does not exist yet, or is empty.
        objects: names of YCB objects; default: all that the tasks have.
        each: recordings per object; every fifth is of a left hand.
        frames: per recording.
        seed: of everything random; the same seed writes the same bytes.
        json: print one JSON object.
    """
    from tasks.dexycb.standin import write_standin
    from tasks.objects import OBJECTS

    with Progress("recordings", quiet=json) as progress:
        try:
            names = write_standin(
                out, objects or tuple(OBJECTS), each, seed, frames,
                lambda done, total: progress.show("recordings", f"{done} of {total} written", done, total, now=done == total),
            )
        except ValueError as error:
            raise ToolkitError(str(error)) from None
        except OSError as error:
            raise ToolkitError(f"{out} cannot be written ({error.strerror}); choose another folder") from None
    size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
    content = {"root": str(out), "recordings": names, "bytes": size, "synthetic": True}
    emit(content, json, f"{len(names)} synthetic recordings, {size / 1e6:.1f} MB, in {out}; look at them with: "
                        + told("recordings", "list", out))


@recordings.command(name="list")
@helped
def list_recordings(root: Annotated[Path, tyro.conf.Positional], frame_rate: float = 25.0, json: bool = False) -> None:
    """Read every recording under a folder, check it, and say what it shows.

    Exit status 2 if one of them is broken; the others are listed all the same.

    Args:
        root: the folder that holds the subjects and `calibration`.
        frame_rate: [Hz]; DexYCB does not say it, 25 is its maintainer's ballpark.
        json: print one JSON object.
    """
    from tasks.dexycb.recording import RecordingError, read_recording, sequences

    try:
        names = sequences(root)
    except RecordingError as error:
        raise ToolkitError(str(error)) from None
    rows, broken = [], []
    with Progress("recordings", quiet=json) as progress:
        for done, name in enumerate(names, 1):
            try:
                recording = read_recording(root, name, frame_rate)
                rows.append({
                    "recording": name, "object": recording.object, "side": recording.side, "frames": recording.frames,
                    "seconds": round(recording.frames / frame_rate, 2), "hand_frames": int(recording.hand_seen.sum()),
                    "object_frames": int(recording.object_seen.sum()), "objects": list(recording.objects),
                })
            except RecordingError as error:
                broken.append({"recording": name, "error": str(error)})
            progress.show("recordings", f"{done} of {len(names)} read", done, len(names))
    if json:
        emit({"root": str(root), "frame_rate": frame_rate, "recordings": rows, "broken": broken}, True, "")
    elif rows:
        columns = ["recording", "object", "side", "frames", "seconds", "hand_frames", "object_frames"]
        table(f"Recordings in {root}", columns, [[row[c] for c in columns] for row in rows])
    if broken:
        more = f" ({len(broken)} of {len(names)} are broken)" if len(broken) > 1 else ""
        raise ToolkitError(broken[0]["error"] + more)


@recordings.command(name="retarget")
@helped
def retarget_recordings(
    root: Annotated[Path, tyro.conf.Positional],
    source: str = "adroit",
    only: tuple[str, ...] = (),
    object: str | None = None,
    frame_rate: float = 25.0,
    record: Path | None = None,
    json: bool = False,
) -> None:
    """Retarget recordings to the source's hand, replay them in simulation, and say how well each is followed.

    Errors are distances of the robot's fingertips from the recorded ones, on average over five fingers. Exit status 2 if one of the
    recordings asked for is broken; the others are retargeted all the same.

    Args:
        root: the folder that holds the subjects and `calibration`.
        source: a robot with a five-fingered hand.
        only: names of recordings, "<subject>/<time>"; default: all.
        object: only recordings of this YCB object.
        frame_rate: [Hz].
        record: write recording, retargeted hand and replay side by side into this .rrd file, for `meta-evolve view`.
        json: print one JSON object.
    """
    robot = find_arm(source)
    from toolkit.demonstrations.replay import Broken, Dropped, Retargeter

    retargeter = Retargeter(root, robot, frame_rate)
    unknown = [name for name in only if name not in retargeter.names]
    if unknown:
        raise ToolkitError(f"recording {unknown[0]!r} is not in {root}; it has: {', '.join(retargeter.names[:5])}, ...")
    chosen, broken, objects = retargeter.about(object, only)
    if not chosen:
        more = f"; {broken[0].why}" if broken else ""
        raise ToolkitError(f"{root} has no recording of {object or 'anything'}; it has: {', '.join(objects) or 'none'}{more}")
    results: list[Demonstration | Dropped | Broken] = []
    with Progress("retargeting", quiet=json) as progress:
        for name in chosen:
            results.append(retargeter.demonstration_of(name))
            good = sum(getattr(result, "succeeded", False) for result in results)
            progress.show("retargeting", f"{good} of {len(results)} replays succeed", len(results), len(chosen))
    shown = [result for result in results if not isinstance(result, Dropped | Broken)]
    dropped = [result for result in results if isinstance(result, Dropped)]
    mine = [result for result in results if isinstance(result, Broken)]
    succeeded = sum(d.succeeded for d in shown)
    content = {
        "root": str(root), "source": source, "recordings": [d.to_json() for d in shown],
        "dropped": [{"recording": d.recording, "why": d.why} for d in dropped],
        "broken": [{"recording": b.recording, "error": b.why} for b in (*mine, *broken)],
        "replays_succeeded": succeeded, "replays": len(shown),
    }
    if json:
        emit(content, True, "")
    else:
        columns = ["recording", "object", "tip error mm", "worst frame", "commanded", "infeasible frames", "replay"]
        table("Retargeted", columns, [_row(d) for d in shown])
        left_out: list[Dropped | Broken] = [*dropped, *mine, *broken]
        for one in left_out:
            emit(None, False, f"left out: {one.why}")
        emit(None, False, f"{succeeded} of {len(shown)} replays reach the recorded goal; "
                          f"{len(shown) - succeeded} fail in physics, {len(dropped)} cannot be followed.")
    if record is not None and shown:
        _film(retargeter, shown, record)
    if mine:
        more = f" ({len(mine)} of {len(results)} are broken)" if len(mine) > 1 else ""
        raise ToolkitError(mine[0].why + more)


def _row(demonstration: "Demonstration") -> list[str]:
    figures = demonstration.to_json()
    return [
        figures["recording"], figures["object"], f"{figures['tip_error_mm']:.1f}", f"{figures['worst_frame_tip_error_mm']:.1f}",
        f"{figures['commanded_tip_error_mm']:.1f}", _ranges(figures["infeasible_frames"]),
        f"reached in {figures['replay_steps']}" if figures["replay_succeeded"] else "failed",
    ]


def _ranges(frames: Sequence[int]) -> str:
    """Frames in ascending order as "3, 21-26", or "-" for none."""
    runs: list[list[int]] = []
    for frame in frames:
        if runs and frame == runs[-1][-1] + 1:
            runs[-1].append(frame)
        else:
            runs.append([frame])
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs) or "-"


def _film(retargeter: "Retargeter", shown: Sequence["Demonstration"], path: Path) -> None:
    """Write recordings, retargeted hands and replays side by side."""
    from toolkit.inspection.recording.hands import Clip, record_clips

    clips = []
    for d in shown:
        trace = retargeter.trace(d)
        clips.append(Clip(
            d.recording.name, d.scene.task.object, 1.0 / d.recording.frame_rate, d.scene.joints(d.recording),
            d.scene.object_poses(d.recording), d.hand, d.motion.frames, d.motion.qpos, trace.model, trace.qpos,
            1.0 / d.scene.task.control_frequency, "reaches the goal" if d.succeeded else "fails",
        ))
    record_clips(path, clips)
