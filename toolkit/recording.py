"""Recordings for the Rerun viewer; the only file that imports rerun.

    tree                        the evolution tree, the same at all times
    metrics/<path>/<key>        curves over the timeline "iteration"
    <entity>/<body>/<geom>      robots: episodes over "time" [s] and "iteration", morphs over "morph"
    summary                     the run in words

Bodies are placed in the world frame and geoms in their body's. A shape is logged when it first appears or changes,
so a mesh is stored once however many episodes are played.
"""

import hashlib
import os
import subprocess
import sysconfig
import uuid
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from toolkit.errors import ToolkitError

SMALLEST_GEOM = 0.5e-3  # [m] a geom smaller than this stands for a part that has shrunk away
FLOOR = 1.5  # [m] half-size to which floors are cut, and size above which walls of a room are left out
KIND_COLOURS = {"source": (86, 180, 233), "meta": (230, 159, 0), "target": (0, 190, 140)}  # apart for colour-blind eyes too
PATH_COLOURS = ((0, 158, 115), (230, 159, 0), (86, 180, 233), (204, 121, 167), (213, 94, 0), (0, 114, 178), (240, 228, 66))
GREY = (128, 128, 128)
CURVES = {  # the curves shown first; any other key gets a tab of its own
    "success_rate": "Success rate [0 to 1]",
    "distance": "Distance to the meta robot",
    "episodes": "Episodes",
}
COLUMN, ROW = 105.0, 70.0  # [viewer units] spacing of the tree drawing
KINDS = {
    mujoco.mjtGeom.mjGEOM_PLANE,
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_MESH,
}


class Shape(NamedTuple):
    """One geom as it is drawn.

    Attributes:
        body: index of its body.
        path: "<body>/<geom>", escaped for Rerun.
        kind: a mujoco.mjtGeom.
        size: (3,) [m] MuJoCo's sizes for that kind.
        position: (3,) [m] and quaternion: (4,) w first, of the geom in its body's frame.
        colour: (4,) 0 to 255.
        mesh: index of its mesh, -1 for a primitive.
        digest: equal for two shapes that are drawn alike but for the pose of a mesh.
    """

    body: int
    path: str
    kind: int
    size: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray
    colour: np.ndarray
    mesh: int
    digest: bytes


class Recording:
    """Writes one .rrd file; what was logged before the process was killed can be viewed.

    A second Recording on the same path, as made by a resumed run, continues the same recording in a new part
    `<name>-1.rrd`, `<name>-2.rrd`, ...; `show` opens all parts together.

    Attributes:
        path: the file that this object writes.
    """

    def __init__(self, path: Path | str, collision: bool = False) -> None:
        """Open the file.

        Args:
            path: the .rrd file.
            collision: draw collision geoms (group 0) instead of visual ones (group 1).

        Raises:
            ToolkitError: the folder cannot be written.
        """
        earlier = recording_parts(Path(path))
        self.path = Path(path) if not earlier else Path(path).with_name(f"{Path(path).stem}-{len(earlier)}.rrd")
        self._collision = collision
        self._logged: dict[tuple[str, str], Any] = {}  # (timeline, entity path) -> what it shows there now
        self._clock: dict[str, tuple[float, int]] = {}  # entity -> start time and phase of its latest episode
        self._curves: dict[str, list[str]] = {}  # key -> paths
        self._waiting: dict[str, list[tuple[int, float]]] = {}  # curve -> steps and values since the last episode
        self._episodes: dict[str, rrb.EyeControls3D] = {}  # entity -> where to look at it from
        self._morphs: dict[str, rrb.EyeControls3D] = {}
        self._summary = False
        self._outdated = False  # whether the latest layout lacks a curve
        self._bounds: rrb.VisualBounds2D | None = None
        self._stream = rr.RecordingStream("meta-evolve", recording_id=self._continue_parts(earlier))
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.touch()
            self._stream.save(self.path)
        except (OSError, RuntimeError) as error:
            raise ToolkitError(f"recording {self.path} cannot be written ({error}); choose a folder that can be") from None
        self._arrange()

    def __enter__(self) -> "Recording":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Finish the file. Logging to it afterwards is lost."""
        if self._outdated:
            self._arrange()
        self._stream.flush()
        self._stream.disconnect()

    def log_summary(self, text: str) -> None:
        """Show a text [Markdown] beside the curves, in place of an earlier one."""
        self._stream.log("summary", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)
        self._summary = True
        self._arrange()

    def log_tree(self, nodes: Sequence[dict[str, Any]], edges: Sequence[dict[str, Any]]) -> None:
        """Draw the evolution tree, from the source on the left to the targets on the right.

        Args:
            nodes: {"name", "kind": "source", "meta" or "target", "alpha"} each.
            edges: {"from", "to": names of nodes, "length"} each; the length is written on the edge.
        """
        position = tree_layout([node["name"] for node in nodes], [(edge["from"], edge["to"]) for edge in edges])
        middles = [f"{edge['from']} to {edge['to']}" for edge in edges]
        points = [position[node["name"]] for node in nodes]
        points += [np.mean([position[edge["from"]], position[edge["to"]]], axis=0) for edge in edges]
        drawn = rr.GraphNodes(
            [node["name"] for node in nodes] + middles,
            positions=points,
            labels=[node["name"] if node["kind"] == "meta" else f"{node['name']} ({node['kind']})" for node in nodes]
            + [f"{edge['length']:.2f}" for edge in edges],
            colors=[KIND_COLOURS.get(node["kind"], GREY) for node in nodes] + [GREY] * len(edges),
            show_labels=True,
        )
        halves = [pair for edge, middle in zip(edges, middles) for pair in ((edge["from"], middle), (middle, edge["to"]))]
        self._stream.log("tree", drawn, rr.GraphEdges(halves, graph_type="undirected"), static=True)
        low, high = np.min(points, axis=0), np.max(points, axis=0)
        self._bounds = rrb.VisualBounds2D(x_range=(low[0] - 0.7 * COLUMN, high[0] + 0.7 * COLUMN), y_range=(low[1] - ROW, high[1] + ROW))
        self._arrange()

    def log_progress(self, step: int, path: str, values: dict[str, float]) -> None:
        """Add a point to the curves of one path of the tree, on the timeline "iteration".

        Args:
            step: the iteration, not decreasing.
            path: the path's name, for instance "source to meta1".
            values: a finite number under each key; "success_rate", "distance" and "episodes" are shown first.
        """
        new = False
        for key, value in values.items():
            entity = rr.new_entity_path(["metrics", path, key])[1:]
            if path not in self._curves.setdefault(key, []):
                self._curves[key].append(path)
                new = True
                colour = PATH_COLOURS[self._path_number(path) % len(PATH_COLOURS)]
                self._stream.log(entity, rr.SeriesLines(names=path, colors=colour, widths=2), static=True)
            self._set_times(iteration=step)
            self._stream.log(entity, rr.Scalars(float(value)))
            self._waiting.setdefault(entity, []).append((step, float(value)))
        self._outdated = self._outdated or new  # a layout is large: it waits for the next episode, or the end
        self._stream.flush()

    def log_episode(
        self, entity: str, model: mujoco.MjModel, qpos: np.ndarray, control_dt: float, start_time: float, phase: int
    ) -> float:
        """Play an episode on the timeline "time"; on "iteration" its last frame shows.

        Frames from the first that is not finite, as a simulation that blew up leaves them, are left out.

        Args:
            entity: where the robot lives, for instance "robot".
            model: the robot and its task; sizes and poses of geoms may differ from call to call.
            qpos: (T, nq) [m, rad] one row per control step.
            control_dt: [s] between rows.
            start_time: [s] of the first row, not decreasing from call to call.
            phase: the iteration, `step` of log_progress, not decreasing.

        Returns:
            The time [s] just after the episode, where the next may start.

        Raises:
            ToolkitError: qpos is not (T, nq), or time runs backwards.
        """
        qpos = self._checked(model, qpos, entity, start_time, phase)
        shapes = shapes_of(model, self._collision)
        positions, quaternions = body_poses(model, qpos)
        self._show_robot(entity, model, positions)
        self._set_times(time=start_time, iteration=phase)
        self._log_shapes(entity, "time", model, shapes)
        times = rr.TimeColumn("time", duration=_duration(start_time + control_dt * np.arange(len(qpos))))
        phases = rr.TimeColumn("iteration", sequence=np.full(len(qpos), phase))
        for body in sorted({shape.body for shape in shapes}):
            if model.body_weldid[body] == 0:
                self._log_pose(entity, "time", model, body, positions[0, body], quaternions[0, body])
                continue
            columns = rr.Transform3D.columns(translation=positions[:, body], quaternion=_x_first(quaternions[:, body]))
            self._stream.send_columns(f"{entity}/{_body_path(model, body)}", [times, phases], columns)
        self._log_label(entity, f"iteration {phase}", model, positions[0])
        end_time = start_time + control_dt * len(qpos)
        self._repeat_curves(start_time, end_time)
        if self._outdated:
            self._arrange()
        self._stream.flush()
        return end_time

    def log_morph(self, entity: str, models: Iterable[tuple[str, mujoco.MjModel, np.ndarray]]) -> None:
        """Show one robot turning into another on the timeline "morph", one frame per model.

        Args:
            entity: where the robot lives, for instance "morph".
            models: (label, model, qpos (nq,) [m, rad]) each; the label floats near the top of the robot.
        """
        for frame, (label, model, qpos) in enumerate(models):
            qpos = _as_rows(model, np.atleast_2d(qpos))
            positions, quaternions = body_poses(model, qpos)
            self._show_robot(entity, model, positions, morph=True)
            self._set_times(morph=frame)
            shapes = shapes_of(model, self._collision)
            self._log_shapes(entity, "morph", model, shapes)
            for body in sorted({shape.body for shape in shapes}):
                self._log_pose(entity, "morph", model, body, positions[0, body], quaternions[0, body])
            self._log_label(entity, label, model, positions[0])
        self._stream.flush()

    # -- shapes and poses

    def _log_shapes(self, entity: str, timeline: str, model: mujoco.MjModel, shapes: list[Shape]) -> None:
        """Log what is new or changed at the stream's time, and clear what is gone."""
        gone = {path for line, path in self._logged if line == timeline and path.startswith(f"{entity}/") and path.count("/") > 1}
        for shape in shapes:
            path = f"{entity}/{shape.path}"
            gone.discard(path)
            if self._changed(timeline, path, shape.digest):
                self._stream.log(path, _archetype(model, shape))
            if shape.mesh >= 0 and self._changed(f"{timeline} pose", path, shape.position.tobytes() + shape.quaternion.tobytes()):
                self._stream.log(path, rr.Transform3D(translation=shape.position, quaternion=_x_first(shape.quaternion)))
        for path in gone:
            self._stream.log(path, rr.Clear(recursive=False))
            self._logged.pop((timeline, path))
            self._logged.pop((f"{timeline} pose", path), None)

    def _log_pose(
        self, entity: str, timeline: str, model: mujoco.MjModel, body: int, position: np.ndarray, quaternion: np.ndarray
    ) -> None:
        path = f"{entity}/{_body_path(model, body)}"
        if self._changed(f"{timeline} pose", path, position.tobytes() + quaternion.tobytes()):
            self._stream.log(path, rr.Transform3D(translation=position, quaternion=_x_first(quaternion)))

    def _log_label(self, entity: str, label: str, model: mujoco.MjModel, positions: np.ndarray) -> None:
        centre, radius = _robot_extent(model, positions)
        above = centre + (0.0, 0.0, 0.75 * radius)  # within the view that _show_robot gives
        self._stream.log(f"{entity}/label", rr.Points3D([above], labels=[label], colors=(40, 40, 40), radii=0.002, show_labels=True))

    def _changed(self, timeline: str, path: str, value: bytes) -> bool:
        changed = self._logged.get((timeline, path)) != value
        self._logged[timeline, path] = value
        return changed

    def _checked(self, model: mujoco.MjModel, qpos: np.ndarray, entity: str, start_time: float, phase: int) -> np.ndarray:
        rows = _as_rows(model, qpos)
        finite = np.isfinite(rows).all(axis=1)
        rows = rows if finite.all() else rows[: int(finite.argmin())]
        if len(rows) == 0:
            raise ToolkitError(f"episode of {entity!r} has no finite frame; pass at least one row of qpos")
        before = self._clock.get(entity, (start_time, phase))
        if start_time < before[0] or phase < before[1]:
            raise ToolkitError(
                f"episode of {entity!r} starts at {start_time} s in phase {phase}, before an earlier one "
                f"({before[0]} s, phase {before[1]}); log episodes in order"
            )
        self._clock[entity] = (start_time, phase)
        return rows

    def _set_times(self, time: float | None = None, iteration: int | None = None, morph: int | None = None) -> None:
        self._stream.reset_time()
        if time is not None:
            self._stream.set_time("time", duration=_duration(time))
        if iteration is not None:
            self._stream.set_time("iteration", sequence=iteration)
        if morph is not None:
            self._stream.set_time("morph", sequence=morph)

    def _repeat_curves(self, start_time: float, end_time: float) -> None:
        """The viewer shows one timeline at a time: on "time", the points since the last episode fill this one."""
        steps = [step for points in self._waiting.values() for step, _ in points]
        for entity, points in self._waiting.items():
            parts = (np.array([step for step, _ in points]) - min(steps)) / (max(steps) - min(steps) + 1)
            times = rr.TimeColumn("time", duration=_duration(start_time + (end_time - start_time) * parts))
            self._stream.send_columns(entity, [times], rr.Scalars.columns(scalars=[value for _, value in points]))
        self._waiting.clear()

    # -- layout

    def _show_robot(self, entity: str, model: mujoco.MjModel, positions: np.ndarray, morph: bool = False) -> None:
        """Give a new entity its place in the layout, seen from in front of it."""
        listed = self._morphs if morph else self._episodes
        if entity not in listed:
            centre, radius = _robot_extent(model, positions)
            position = centre + radius * np.array([1.6, -1.5, 0.9])
            listed[entity] = rrb.EyeControls3D(position=position, look_target=centre, eye_up=(0.0, 0.0, 1.0))
            self._arrange()

    def _arrange(self) -> None:
        """Send the layout of what has been logged so far; the viewer uses the latest."""
        robots = [_robot_view("Robot", self._episodes)] if self._episodes else []
        robots += [_robot_view('Morph (timeline "morph")', self._morphs)] if self._morphs else []
        others = [rrb.TextDocumentView(origin="summary", name="Summary")] if self._summary else []
        others += [self._curve_view(key) for key in self._curves if key not in CURVES]
        right = [rrb.GraphView(origin="tree", name="Evolution tree", visual_bounds=self._bounds)] if self._bounds else []
        right += [self._curve_view(key) for key in CURVES if key in self._curves]
        right += [rrb.Tabs(*others)] if others else []
        shares = [3 if isinstance(view, rrb.GraphView) else 2 for view in right]
        columns = ([rrb.Tabs(*robots)] if robots else []) + ([rrb.Vertical(*right, row_shares=shares)] if right else [])
        timeline = "time" if self._episodes else "morph" if self._morphs else "iteration"
        blueprint = rrb.Blueprint(
            rrb.Horizontal(*columns),
            rrb.BlueprintPanel(state="collapsed"),
            rrb.SelectionPanel(state="collapsed"),
            rrb.TimePanel(state="collapsed", timeline=timeline),
            auto_views=False,
        )
        self._stream.send_blueprint(blueprint)
        self._outdated = False
        self._stream.flush()

    def _curve_view(self, key: str) -> rrb.TimeSeriesView:
        first = key == next((shown for shown in CURVES if shown in self._curves), None)
        return rrb.TimeSeriesView(
            origin="metrics",
            name=CURVES.get(key, key),
            contents=[str(rr.new_entity_path(["metrics", path, key])) for path in self._curves[key]],
            axis_y=rrb.ScalarAxis(range=(-0.02, 1.02)) if key == "success_rate" else None,
            plot_legend=rrb.PlotLegend(visible=first or key not in CURVES, corner=rrb.Corner2D.RightBottom),
        )

    def _path_number(self, path: str) -> int:
        names = dict.fromkeys(name for paths in self._curves.values() for name in paths)
        return list(names).index(path)

    # -- parts

    def _continue_parts(self, earlier: list[Path]) -> str:
        """The recording's identity, and its curves so that the new layout lists them; torn parts are mended."""
        identity = str(uuid.uuid4())
        for part in earlier:
            try:
                reader = _reader(part)
            except ToolkitError:
                _mend(part)
                reader = _reader(part)
            identity = reader.recordings()[0].recording_id
            for path, key in curves_of(part):
                if path not in self._curves.setdefault(key, []):
                    self._curves[key].append(path)
        return identity


def _robot_view(name: str, eyes: dict[str, rrb.EyeControls3D]) -> rrb.Spatial3DView:
    """A view of the given entities, through the first one's eye."""
    return rrb.Spatial3DView(
        origin="/",
        name=name,
        contents=[f"/{entity}/**" for entity in eyes],
        eye_controls=next(iter(eyes.values())),
        background=(236, 239, 244),
        line_grid=False,
    )


# -- geometry


def shapes_of(model: mujoco.MjModel, collision: bool = False) -> list[Shape]:
    """The geoms to draw, each body's visual ones (group 1) or, where it has none, its group 0.

    A body is taken together with those of its robot that are rigidly joined to it: a pedestal's collision boxes stay
    hidden when the pedestal's own picture hangs on the body beside them.

    Left out: other groups, geoms under 0.5 mm, invisible ones, and the walls of a room, which would hide the robot.

    Args:
        model: any model.
        collision: draw group 0 throughout.
    """
    rigid = list(zip(model.body_weldid.tolist(), model.body_rootid.tolist()))
    visual = {rigid[model.geom_bodyid[geom]] for geom in range(model.ngeom) if model.geom_group[geom] == 1}
    shapes = []
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        group = 0 if collision or rigid[body] not in visual else 1
        floor = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE
        wall = model.body_weldid[body] == 0 and model.geom_rbound[geom] > FLOOR and not floor
        if (model.geom_group[geom] == group or floor) and not wall and model.geom_type[geom] in KINDS:
            shape = _shape(model, geom)
            if shape.colour[3] > 0 and (floor or _largest(shape) >= SMALLEST_GEOM):
                shapes.append(shape)
    return shapes


def body_poses(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where every body is.

    Args:
        model: the robot.
        qpos: (T, nq) [m, rad].

    Returns:
        Positions (T, nbody, 3) [m] and quaternions (T, nbody, 4), w first, in the world frame.
    """
    data = mujoco.MjData(model)
    positions = np.empty((len(qpos), model.nbody, 3))
    quaternions = np.empty((len(qpos), model.nbody, 4))
    for frame, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        positions[frame], quaternions[frame] = data.xpos, data.xquat
    return positions, quaternions


def tree_layout(names: Sequence[str], edges: Sequence[tuple[str, str]]) -> dict[str, tuple[float, float]]:
    """A place for every node: depth sets x, leaves take rows, a parent sits between its children.

    Args:
        names: the nodes; each node that no edge leads to is a root.
        edges: (from, to) names.
    """
    children = {name: [to for start, to in edges if start == name] for name in names}
    places: dict[str, tuple[float, float]] = {}
    rows = 0

    def place(name: str, depth: int) -> float:
        nonlocal rows
        places[name] = (depth * COLUMN * 2, 0.0)  # taken before its children, so that a cycle ends
        below = [place(child, depth + 1) for child in children[name] if child not in places]
        row = float(np.mean(below)) if below else float(rows)
        rows += not below
        places[name] = (depth * COLUMN * 2, row * ROW)
        return row

    entered = {to for _, to in edges}
    for name in sorted(names, key=lambda name: name in entered):
        if name not in places:
            place(name, 0)
    return places


def _shape(model: mujoco.MjModel, geom: int) -> Shape:
    kind, mesh = int(model.geom_type[geom]), -1
    size, position, quaternion = model.geom_size[geom].copy(), model.geom_pos[geom].copy(), model.geom_quat[geom].copy()
    colour = _colour(model, geom)
    parts = [bytes([kind]), colour.tobytes()]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        vertices = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
        parts.append(model.mesh_vert[vertices].tobytes())
    else:
        parts += [size.tobytes(), position.tobytes(), quaternion.tobytes()]
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or f"geom{geom}"
    body = int(model.geom_bodyid[geom])
    path = f"{_body_path(model, body)}/{rr.escape_entity_path_part(name)}"
    return Shape(body, path, kind, size, position, quaternion, colour, mesh, hashlib.sha256(b"".join(parts)).digest())


def _archetype(model: mujoco.MjModel, shape: Shape) -> rr.AsComponents:
    """The shape in Rerun's terms, placed in its body's frame; meshes get their pose from a transform instead."""
    size, kind = shape.size, shape.kind
    look = {"colors": [shape.colour], "fill_mode": "solid"}
    at = {"quaternions": [_x_first(shape.quaternion)], **look}
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _mesh(model, shape)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:  # Rerun's starts at its origin, MuJoCo's is centred there
        axis = np.zeros(3)
        mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), shape.quaternion)
        return rr.Capsules3D(radii=[size[0]], lengths=[2 * size[1]], translations=[shape.position - axis * size[1]], **at)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return rr.Cylinders3D(radii=[size[0]], lengths=[2 * size[1]], centers=[shape.position], **at)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return rr.Boxes3D(half_sizes=[size], centers=[shape.position], **at)
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:  # size 0 means endless
        half = [min(extent or FLOOR, FLOOR) for extent in size[:2]]
        return rr.Boxes3D(half_sizes=[[*half, SMALLEST_GEOM]], centers=[shape.position], **at)
    radii = [size[0]] * 3 if kind == mujoco.mjtGeom.mjGEOM_SPHERE else size
    return rr.Ellipsoids3D(half_sizes=[radii], centers=[shape.position], **at)


def _mesh(model: mujoco.MjModel, shape: Shape) -> rr.Mesh3D:
    """MuJoCo indexes normals apart from vertices, Rerun together: one vertex per pair that a face uses."""
    mesh = shape.mesh
    faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
    pairs = np.stack([model.mesh_face[faces].ravel(), model.mesh_facenormal[faces].ravel()], axis=1)
    pairs, triangles = np.unique(pairs, axis=0, return_inverse=True)
    return rr.Mesh3D(
        vertex_positions=model.mesh_vert[model.mesh_vertadr[mesh] + pairs[:, 0]],
        vertex_normals=model.mesh_normal[model.mesh_normaladr[mesh] + pairs[:, 1]],
        triangle_indices=triangles.reshape(-1, 3),
        albedo_factor=shape.colour,
    )


def _colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """(4,) 0 to 255: MuJoCo's rule (a geom's colour wins over its material's unless left at grey), textures averaged."""
    rgba, material = model.geom_rgba[geom].copy(), model.geom_matid[geom]
    if material >= 0:
        if np.array_equal(rgba, np.array([0.5, 0.5, 0.5, 1.0], np.float32)):
            rgba = model.mat_rgba[material].copy()
        texture = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]
        if texture >= 0 and model.tex_nchannel[texture] >= 3:
            channels = model.tex_nchannel[texture]
            start = model.tex_adr[texture]
            texels = model.tex_data[start : start + model.tex_width[texture] * model.tex_height[texture] * channels]
            rgba[:3] *= texels.reshape(-1, channels)[::97, :3].mean(axis=0) / 255  # a sample of the texels is plenty
    return np.round(255 * np.clip(rgba, 0, 1)).astype(np.uint8)


def _largest(shape: Shape) -> float:
    """[m] The largest half-extent."""
    sizes = {mujoco.mjtGeom.mjGEOM_SPHERE: 1, mujoco.mjtGeom.mjGEOM_CAPSULE: 1}.get(shape.kind, 3)
    return float(shape.size[:sizes].max())


def _robot_extent(model: mujoco.MjModel, positions: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre [m] and radius [m] of the jointed bodies; positions: (..., nbody, 3) [m] in the world frame."""
    moving = positions[..., model.body_weldid > 0, :].reshape(-1, 3)
    if len(moving) == 0:
        moving = positions.reshape(-1, 3)
    low, high = moving.min(axis=0), moving.max(axis=0)
    return (low + high) / 2, max(0.2, float(np.linalg.norm(high - low)) / 2)


def _body_path(model: mujoco.MjModel, body: int) -> str:
    return rr.escape_entity_path_part(mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body) or f"body{body}")


def _as_rows(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    rows = np.asarray(qpos, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != model.nq:
        raise ToolkitError(f"qpos has shape {np.shape(qpos)}; this model needs (frames, {model.nq})")
    return rows


def _x_first(quaternion: np.ndarray) -> np.ndarray:
    """MuJoCo's w-first quaternions (..., 4) in Rerun's order."""
    return np.roll(quaternion, -1, axis=-1)


def _duration(seconds: float | np.ndarray) -> np.ndarray:
    """Whole microseconds, so that a frame and the shapes logged with it fall on the same instant."""
    return np.round(np.asarray(seconds, dtype=np.float64) * 1e6).astype("timedelta64[us]")[()]


# -- files


def recording_parts(path: Path) -> list[Path]:
    """The parts of a recording that exist, in order: <name>.rrd, <name>-1.rrd, ..."""
    parts = [path]
    while parts[-1].exists():
        parts.append(path.with_name(f"{path.stem}-{len(parts)}.rrd"))
    return parts[:-1]


def curves_of(path: Path | str) -> list[tuple[str, str]]:
    """(path, key) of every curve in a recording, sorted.

    Raises:
        ToolkitError: a truncated or foreign file.
    """
    chunks = _reader(Path(path)).stream().filter(content="/metrics/**")
    return sorted({_curve_of(chunk.entity_path) for chunk in chunks})


def show(path: Path | str) -> str:
    """Open a recording in the Rerun viewer, in a process of its own.

    Args:
        path: an .rrd file, shown with its later parts, or a run folder with a recording.rrd.

    Returns:
        A sentence for the user: what was opened or, without a display, the command that serves it to a browser.

    Raises:
        ToolkitError: no such recording, a truncated or foreign file, or no viewer.
    """
    path = Path(path)
    parts = recording_parts(path / "recording.rrd" if path.is_dir() else path)
    if not parts:
        raise ToolkitError(f"no recording at {path}; give an .rrd file, or the folder of a run that records")
    for part in parts:
        _reader(part)
    command = [str(_viewer()), *map(str, parts)]
    if os.name == "posix" and os.uname().sysname == "Linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        return (
            f"no display here; run `rerun --serve-web {' '.join(command[1:])}` and open http://localhost:9090 in a browser "
            "(from another machine, forward ports 9090 and 9876 with ssh -L first)"
        )
    subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    return f"opened {', '.join(command[1:])} in the Rerun viewer"


def _reader(path: Path) -> RrdReader:
    """Open a file for reading, or say what is wrong with it."""
    try:
        with open(path, "rb") as file:
            ours = file.read(4) == b"RRF2"
    except OSError as error:
        raise ToolkitError(f"recording {path} cannot be read ({error.strerror}); check the path") from None
    if not ours:
        raise ToolkitError(f"{path} is not a Rerun recording; give an .rrd file written by `meta-evolve transfer`")
    try:
        with warnings.catch_warnings():  # a killed run's file has no footer, and reads well without
            warnings.simplefilter("ignore")
            reader = RrdReader(path)
            found = reader.recordings()
    except (RuntimeError, ValueError):
        found = []
    if not found:
        raise ToolkitError(
            f"recording {path} is cut off; save its readable part with `rerun rrd merge {path} -o mended.rrd`, or resume its run"
        )
    return reader


def _mend(path: Path) -> None:
    """Drop the message that was being written when a run was killed."""
    temporary = path.with_name(f".{path.name}.tmp")
    answer = subprocess.run([str(_viewer()), "rrd", "merge", str(path), "-o", str(temporary)], capture_output=True, check=False)
    if answer.returncode != 0 or not temporary.exists():
        raise ToolkitError(f"recording {path} is damaged beyond mending; delete it")
    os.replace(temporary, path)


def _viewer() -> Path:
    """The `rerun` program of this environment."""
    name = "rerun.exe" if os.name == "nt" else "rerun"
    program = Path(sysconfig.get_path("scripts")) / name
    if not program.exists():
        raise ToolkitError(f"the Rerun viewer {program} is missing; run `pip install --force-reinstall rerun-sdk`")
    return program


def _curve_of(entity: str) -> tuple[str, str]:
    """(path, key) of a curve's entity, unescaped."""
    _, _, path, key = (part.replace("\0", "/") for part in entity.replace("\\/", "\0").split("/"))
    return path.replace("\\", ""), key.replace("\\", "")
