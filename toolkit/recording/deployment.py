"""A deployment's log as curves for the Rerun viewer: what each tick cost, how old its state was, when the arm was held."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import rerun as rr

from toolkit.deploy.runtime import LOG_FORMAT, STAGES
from toolkit.errors import ToolkitError


def record_deployment(log: Path) -> Path:
    """Draw a log of ``deploy --log`` into an .rrd file beside it; returns that file.

    Raises:
        ToolkitError: no such log, or another file.
    """
    about, rows = _read(log)
    out = log.with_suffix(".rrd")
    out.unlink(missing_ok=True)
    ticks = [row for row in rows if "tick" in row]
    stream = rr.RecordingStream("meta-evolve deployment")
    stream.save(out)
    for step, row in enumerate(ticks):
        stream.set_time("tick", sequence=step)
        values = {f"time/{stage}_ms": row[f"{stage}_ms"] for stage in STAGES}
        values["time/tick_ms"] = sum(row[f"{stage}_ms"] for stage in STAGES[1:4])
        values |= {"state/held": float(row["hold"]), "state/late": float(row["late"]), "state/episode": float(row["episode"])}
        values |= {"age/state_ms": row["age_ms"]} if "age_ms" in row else {}
        for name, value in values.items():
            stream.log(name, rr.Scalars(value))
    stream.log("summary", rr.TextDocument(_summary(about, rows, ticks), media_type=rr.MediaType.MARKDOWN), static=True)
    stream.flush()
    stream.disconnect()
    return out


def _read(log: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    try:
        lines = log.read_text(encoding="utf-8").splitlines()
        about = json.loads(lines[0]) if lines else {}
        rows = [json.loads(line) for line in lines[1:] if line.endswith("}")]  # a killed run leaves a torn last line
    except (OSError, ValueError) as error:
        raise ToolkitError(f"{log} is no deployment log ({error}); give a file that `meta-evolve deploy --log` wrote") from None
    if not isinstance(about, dict) or about.get("format") != LOG_FORMAT:
        raise ToolkitError(f"{log} is no deployment log; give a file that `meta-evolve deploy --log` wrote")
    return about, rows


def _summary(about: dict[str, Any], rows: list[dict[str, Any]], ticks: list[dict[str, Any]]) -> str:
    faults = Counter(row["fault"] for row in ticks if "fault" in row)
    played = f"{len(ticks)} ticks, {about.get('form')} commands, {about.get('pace')}."
    lines = [f"# {about.get('robot')}: {about.get('task')}", "", played, ""]
    lines += [f"- held for {kind}: {count} ticks" for kind, count in faults.items()] or ["No fault."]
    lines += [f"- episode {row['episode']} stopped: {row['stop']}" for row in rows if "stop" in row]
    return "\n".join(lines)
