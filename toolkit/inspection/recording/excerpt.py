"""One page of a recording at one moment, as a small recording of its own: to send, to embed, to take a picture of.

A viewer fetches a run's recording piece by piece. A program that takes its picture as soon as the viewer opens
(`rerun FILE --screenshot-to PNG`) is too early for that; an excerpt is there at once. Nothing in it moves: robots are baked into
one mesh, curves reach a few seconds to both sides.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from scipy.spatial.transform import Rotation

from toolkit.errors import ToolkitError
from toolkit.inspection.recording.layout import page_timeline
from toolkit.inspection.recording.rollouts import WINDOW
from toolkit.inspection.recording.stream import FILM, ITERATION, Stream
from toolkit.inspection.recording.viewer import chunks_of

ROOTS = {
    "evolution": ("/evolution/tree", "/evolution/pca2", "/evolution/pca3", "/evolution/alpha"),
    "morph": ("/scene", "/evolution/tree", "/evolution/changes"),
    "rollouts": ("/scene", "/signals"),
    "learning": ("/learning",),
    "summary": ("/summary", "/evolution/tree", "/evolution/pca2"),
    "compare": ("/scene", "/side"),
}
"""Page -> the entities that it shows."""
CURVE, MESH, PLACES, TURNS, FADE = (
    "Scalars:scalars", "Mesh3D:vertex_positions", "InstancePoses3D:translations", "InstancePoses3D:quaternions", "Mesh3D:albedo_factor",
)
ALWAYS = np.iinfo(np.int64).min


@dataclass(frozen=True, eq=False)
class Part:
    """What a component of an entity is at the moment: the component, its values, and since when [ns], ALWAYS if it is static."""

    descriptor: rr.ComponentDescriptor
    values: pa.Array
    since: int

    def as_arrow_array(self) -> pa.Array:
        """For rerun."""
        return self.values


def moment_of(file: Path, at: float | None, page: str) -> float:
    """``at``, or the recording's last moment: [s] of the film, or number of the iteration."""
    if at is not None:
        return at
    timeline = page_timeline(page)
    ends = [stamps.max() for chunk in chunks_of(file) if (stamps := _stamps(chunk.to_record_batch(), timeline)).size]
    return float(max(ends, default=0)) / (1 if timeline == ITERATION else 1e9)


def excerpt(file: Path, page: str, at: float, layout: rrb.Blueprint, out: Path) -> None:
    """Write one page of a recording as it is at one moment.

    Args:
        file: the recording.
        page: one of ROOTS.
        at: [s] of the film; on the page learning the number of the iteration up to which curves go.
        layout: of the page.
        out: .rrd file.

    Raises:
        ToolkitError: the recording holds nothing of the page up to then.
    """
    timeline = page_timeline(page)
    shown = [chunk for chunk in chunks_of(file) if chunk.entity_path.startswith(ROOTS[page])]
    state: dict[str, dict[str, Part]] = {}
    curves: list[tuple[str, np.ndarray, list[np.ndarray]]] = []
    for chunk in shown:
        batch, entity = chunk.to_record_batch(), chunk.entity_path
        stamps = _stamps(batch, timeline)
        if CURVE in batch.schema.names:
            curves += _kept(entity, stamps, batch.column(CURVE), at, timeline)
        elif stamps.size or chunk.is_static:
            _update(state.setdefault(entity, {}), batch, stamps, int(at * 1e9))
    moving = any(part.since > ALWAYS for parts in state.values() for part in parts.values())
    if not moving and not curves and page != "summary":
        raise ToolkitError(f"{file} shows nothing of the page {page} at {at:g}; choose another --at, or remake it with --rebuild")
    stream = Stream(out)
    stream.arrange(layout)
    for entity, parts in _baked({entity: parts for entity, parts in state.items() if parts}):
        stream.static(entity, [rr.DescribedComponentBatch(part, part.descriptor) for part in parts.values()])
    for entity, stamps, rows in curves:
        columns = rr.Scalars.columns(scalars=np.concatenate(rows)).partition([len(row) for row in rows])
        stream.rows(entity, *((1e-9 * stamps, None) if timeline == FILM else (None, stamps)), columns)
    stream.close()


def _stamps(batch: pa.RecordBatch, timeline: str) -> np.ndarray:
    """When a chunk's rows are: [ns] of the film, or number of the iteration; empty if on neither."""
    if timeline not in batch.schema.names:
        return np.empty(0, np.int64)
    return batch.column(timeline).cast(pa.int64()).to_numpy(zero_copy_only=False)


def _update(parts: dict[str, Part], batch: pa.RecordBatch, stamps: np.ndarray, at: int) -> None:
    """Take from a chunk what holds at a moment [ns]."""
    if not stamps.size:
        stamps = np.full(batch.num_rows, ALWAYS)
    for field, column in zip(batch.schema, batch.columns, strict=True):
        about = field.metadata or {}
        if about.get(b"rerun:kind") != b"data":
            continue
        known = np.flatnonzero(column.is_valid().to_numpy(zero_copy_only=False) & (stamps <= at))
        if not known.size:
            continue
        row = known[len(known) - 1 - np.argmax(stamps[known][::-1])]
        if field.name not in parts or stamps[row] >= parts[field.name].since:
            component = about[b"rerun:component"].decode()  # all data has one
            more = [about[key].decode() if key in about else None for key in (b"rerun:archetype", b"rerun:component_type")]
            parts[field.name] = Part(rr.ComponentDescriptor(component, *more), column[int(row)].values, int(stamps[row]))


def _kept(
    entity: str, stamps: np.ndarray, values: pa.Array, at: float, timeline: str
) -> Iterator[tuple[str, np.ndarray, list[np.ndarray]]]:
    """The rows of a curve around the moment, on the iterations all up to it, with their stamps; nothing if there are none."""
    low, high = (1e9 * (at - WINDOW), 1e9 * (at + WINDOW)) if timeline == FILM else (0, at)
    kept = [row for row in np.argsort(stamps, kind="stable") if low <= stamps[row] <= high and values[int(row)].is_valid]
    if kept:
        yield entity, stamps[kept], [np.asarray(values[int(row)].values) for row in kept]


def _baked(state: dict[str, dict[str, Part]]) -> Iterator[tuple[str, dict[str, Part]]]:
    """Entities with their parts; meshes that stand somewhere become one per opacity, in the world's frame."""
    groups: dict[int, list[tuple[np.ndarray, ...]]] = {}
    template: dict[str, Part] = {}
    for entity, parts in state.items():
        if MESH not in parts:
            yield entity, parts
        elif PLACES in parts and len(parts[PLACES].values):
            opacity = int(np.asarray(parts[FADE].values)[0]) & 0xFF if FADE in parts else 255
            template = template or {key: part for key, part in parts.items() if key.startswith("Mesh3D:")}
            groups.setdefault(opacity, []).extend(_instances(parts))
    for opacity, meshes in groups.items():
        starts = np.cumsum([0, *(len(vertices) for vertices, *_ in meshes)])
        vertices, normals, colours = (np.concatenate([mesh[k] for mesh in meshes]) for k in range(3))
        faces = np.concatenate([mesh[3] + start for mesh, start in zip(meshes, starts[:-1], strict=True)])
        mesh = rr.Mesh3D(vertex_positions=vertices, vertex_normals=normals, vertex_colors=colours, triangle_indices=faces,
                         albedo_factor=(255, 255, 255, opacity))
        yield f"scene/baked/{opacity}", {str(k): Part(batch.component_descriptor(), batch.as_arrow_array(), 0)
                                         for k, batch in enumerate(mesh.as_component_batches())}


def _instances(parts: dict[str, Part]) -> Iterator[tuple[np.ndarray, ...]]:
    """(vertices, normals, colours, faces) of every instance of a mesh, in the world's frame."""
    array = lambda key, width: np.asarray(parts[key].values.flatten()).reshape(-1, width)  # noqa: E731
    vertices, normals, faces = array(MESH, 3), array("Mesh3D:vertex_normals", 3), array("Mesh3D:triangle_indices", 3)
    colours = np.asarray(parts["Mesh3D:vertex_colors"].values)
    for place, turn in zip(array(PLACES, 3), Rotation.from_quat(array(TURNS, 4)), strict=True):
        yield turn.apply(vertices) + place, turn.apply(normals), colours, faces
