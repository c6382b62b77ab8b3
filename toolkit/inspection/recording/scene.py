"""The robot in 3-D: every mesh once, as many instances of it as there are links that look so, placed anew in every frame.

    scene/robot/<mesh>     instances of one mesh; it fades as its robot melts into another
    scene/robot/bones      the merged robot's links as capsules; scene/robot/pads, boxes: what touches, as wireframes
    scene/robot/capsules, boxes, cylinders, ellipsoids: of a family, what is no mesh
    scene/object, goal, trail, target, contacts, label
    framing                from where one looks: of the scene, then of the robot, the eye and the point looked at
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import Chunk

from toolkit.inspection.appearance import Mesh
from toolkit.inspection.furniture import opacity
from toolkit.inspection.recording.layout import Eye, robot_view
from toolkit.inspection.recording.stream import Stream, x_first
from toolkit.inspection.trajectory import PickTrajectory, Trajectory
from toolkit.inspection.visual import Motion, Part, Primitives, Visual, held

FAINT = 0.02
"""A robot of less weight is not drawn."""
METRES_PER_NEWTON = 0.01
"""Length of a contact's arrow."""
LONGEST_ARROW = 0.25
"""[m] for the jolts of a simulation that comes apart."""
THINNEST = 0.001
"""Half length [m] of a solid under which its wireframe is not drawn."""
LABEL, GOAL, TRAIL, AIM, PUSH = (70, 74, 82), (0, 158, 115), (0, 114, 178), (230, 159, 0), (213, 94, 0)


class Scene:
    """Draws motions.

    Args:
        stream: to draw into.
        visual: that makes them.
        tolerance: [m] around a goal that has a place; None: the task has none.
        offsets: [m] where the robots stand; one, or one per robot that is compared.
    """

    def __init__(
        self, stream: Stream, visual: Visual, tolerance: float | None = None, offsets: Sequence[np.ndarray] = (np.zeros(3),)
    ) -> None:
        self.stream, self.visual, self.offsets = stream, visual, [np.asarray(offset, float) for offset in offsets]
        self._users = [np.flatnonzero(visual.instances[:, 0] == mesh).tolist() for mesh in range(len(visual.meshes))]
        self._shown: dict[int, bool] = {}
        names = [mesh.name for mesh in visual.meshes]
        self.entities = [f"scene/robot/{name}" if names.count(name) == 1 else f"scene/robot/{name}-{k}" for k, name in enumerate(names)]
        for entity, mesh in zip(self.entities, visual.meshes, strict=True):
            stream.static(entity, _triangles(mesh))
        for name, drawn in visual.primitives.items():
            stream.static(f"scene/robot/{name}", _style(drawn, len(self.offsets)))
        if visual.carried is not None:
            stream.static("scene/goal", rr.Ellipsoids3D.from_fields(colors=GOAL, fill_mode="majorwireframe", line_radii=0.001))
            stream.static("scene/trail", rr.LineStrips3D.from_fields(colors=TRAIL, radii=0.0015))
            stream.static("scene/target", rr.Points3D.from_fields(colors=AIM, radii=0.006))
            stream.static("scene/contacts", rr.Arrows3D.from_fields(colors=PUSH, radii=0.0015))
            stream.static("scene/object", _triangles(visual.carried))
        stream.static("scene/label", rr.Points3D.from_fields(colors=LABEL, radii=0.001, show_labels=True))
        stream.static("framing", rr.Points3D(np.concatenate([visual.framing.whole, visual.framing.near])))
        for k, mesh in enumerate(visual.scenery):
            upright = [(0.0, 0.0, 0.0, 1.0)] * len(offsets)
            stream.static(f"scene/furniture/{k}", _triangles(mesh), rr.InstancePoses3D(translations=self.offsets, quaternions=upright))
        self.tolerance = tolerance

    def show(self, times: np.ndarray, iteration: int, motions: Sequence[Motion]) -> None:
        """Draw robots over T frames, from ``times`` (T,) [s] on; a motion that is shorter stands still at its end."""
        motions = [motion.moved(offset).stretched(len(times)) for motion, offset in zip(motions, self.offsets, strict=True)]
        for mesh in range(len(self.entities)):
            self._show_mesh(mesh, times, iteration, motions)
        for name, drawn in self.visual.primitives.items():
            self._show_primitives(name, drawn, times, iteration, motions)
        if self.visual.carried is not None:
            carried = np.stack([motion.carried for motion in motions if motion.carried is not None], axis=1)
            self.stream.rows("scene/object", times, iteration, _poses(carried[..., :3], carried[..., 3:]))

    def act(self, times: np.ndarray, iteration: int, trajectories: Sequence[Trajectory]) -> None:
        """Draw what else trajectories show that ``show`` has drawn the robots of: of picks goals, trails, targets and contacts."""
        pairs = [(each, offset) for each, offset in zip(trajectories, self.offsets, strict=True) if isinstance(each, PickTrajectory)]
        if self.tolerance is None or len(pairs) < len(trajectories):
            return
        goals = [each.goal + offset for each, offset in pairs]
        begin, sizes = float(times[0]), [[self.tolerance] * 3] * len(trajectories)
        self.stream.row("scene/goal", begin, iteration, rr.Ellipsoids3D.from_fields(centers=goals, half_sizes=sizes))
        trails = [each.grasp + offset for each, offset in pairs]
        self.stream.row("scene/trail", begin, iteration, rr.LineStrips3D.from_fields(strips=trails))
        steps = len(times) - 1
        if steps < 1:
            return
        aims = np.stack([held(each.target, steps) + offset for each, offset in pairs], axis=1)
        columns = rr.Points3D.columns(positions=aims.reshape(-1, 3)).partition([len(trajectories)] * steps)
        self.stream.rows("scene/target", times[1:], iteration, columns)
        self._touches(times, iteration, pairs)

    def clear_act(self, time: float, iteration: int) -> None:
        """Take away what belongs to an episode."""
        if self.visual.carried is None:
            return
        none, at = np.empty((0, 3)), (np.array([time]), iteration)
        self.stream.rows("scene/goal", *at, rr.Ellipsoids3D.columns(centers=none, half_sizes=none).partition([0]))
        self.stream.row("scene/trail", time, iteration, rr.LineStrips3D.from_fields(strips=[]))
        self.stream.rows("scene/target", *at, rr.Points3D.columns(positions=none).partition([0]))
        self.stream.rows("scene/contacts", *at, rr.Arrows3D.columns(origins=none, vectors=none).partition([0]))

    def label(self, time: float, iteration: int, texts: Sequence[str]) -> None:
        """Write over each robot what it is."""
        places = [self.visual.framing.label + offset for offset in self.offsets]
        self.stream.row("scene/label", time, iteration, rr.Points3D.from_fields(positions=places, labels=texts))

    # ---- parts ------------------------------------------------------------------------------------------------

    def _show_mesh(self, mesh: int, times: np.ndarray, iteration: int, motions: Sequence[Motion]) -> None:
        users = self._users[mesh]
        robots = self.visual.instances[users, 1]
        positions = np.concatenate([motion.positions[:, users] for motion in motions], axis=1)
        quaternions = np.concatenate([motion.quaternions[:, users] for motion in motions], axis=1)
        faint = FAINT if len(motions) == 1 else 0.5  # one opacity serves all instances: of robots side by side, no ghosts
        seen = np.concatenate([_seen(motion, users, robots, faint) for motion in motions], axis=1)
        if not seen.any():
            if self._shown.get(mesh, True):
                times, seen, positions, quaternions = times[:1], seen[:1], positions[:1], quaternions[:1]
            else:
                return
        self._shown[mesh] = bool(seen.any())
        unique = sorted(set(robots.tolist()))
        weights = [motion.weights[: len(times)] for motion in motions]
        shown = np.max([opacity(each[:, unique].sum(axis=1), each.max(axis=1)) for each in weights], axis=0)
        colours = [(255, 255, 255, int(value)) for value in np.round(255 * shown)]
        columns = _poses(positions[seen], quaternions[seen], lengths=seen.sum(axis=1))
        self.stream.rows(self.entities[mesh], times, iteration, columns, rr.Mesh3D.columns(albedo_factor=colours))

    def _show_primitives(self, name: str, drawn: Primitives, times: np.ndarray, iteration: int, motions: Sequence[Motion]) -> None:
        places, turns, sizes = (np.concatenate([motion.parts[name][k] for motion in motions], axis=1) for k in range(3))
        columns = _solids(drawn, (places, turns, sizes))
        there = np.ones(places.shape[:2], bool)
        if drawn.wire:  # of what has shrunk to nothing the lines would still be drawn, as a dot
            there = sizes.max(axis=-1) > THINNEST
            columns = {key: values[there.ravel()] for key, values in columns.items()}
        if drawn.columns is not None:
            shown = np.concatenate(
                [opacity(motion.weights[:, drawn.columns], motion.weights.max(axis=1, keepdims=True)) for motion in motions], axis=1
            )
            colours = np.tile(drawn.colours, (len(times), len(motions), 1)).astype(float)
            colours[..., 3] *= shown
            columns["colors"] = np.round(colours).astype(np.uint8).reshape(-1, 4)
        archetype = ARCHETYPES[drawn.kind]
        self.stream.rows(f"scene/robot/{name}", times, iteration,
                         archetype.columns(**columns).partition(there.sum(axis=1)))

    def _touches(self, times: np.ndarray, iteration: int, pairs: Sequence[tuple[PickTrajectory, np.ndarray]]) -> None:
        """Contacts of each trajectory, where its robot stands."""
        origins: list[np.ndarray] = []
        vectors: list[np.ndarray] = []
        lengths: list[int] = []
        for step in range(len(times) - 1):
            points = [each.points[step] + offset for each, offset in pairs if step < len(each.points)]
            forces = [each.forces[step] for each, _ in pairs if step < len(each.forces)]
            origins += points
            vectors += forces
            lengths.append(sum(len(point) for point in points))
        arrows = np.concatenate(vectors) * METRES_PER_NEWTON if vectors else np.empty((0, 3))
        size = np.linalg.norm(arrows, axis=1, keepdims=True)
        arrows = arrows * np.minimum(1.0, LONGEST_ARROW / np.maximum(size, 1e-9))
        if len(arrows):
            columns = rr.Arrows3D.columns(origins=np.concatenate(origins), vectors=arrows).partition(lengths)
            self.stream.rows("scene/contacts", times[1:], iteration, columns)


ARCHETYPES: dict[str, Any] = {"capsules": rr.Capsules3D, "boxes": rr.Boxes3D, "cylinders": rr.Cylinders3D, "ellipsoids": rr.Ellipsoids3D}


def _style(drawn: Primitives, copies: int) -> rr.AsComponents:
    """What is the same of primitives at all times."""
    colours = np.tile(drawn.colours, (copies, 1)) if drawn.colours.ndim > 1 else drawn.colours
    style = {} if drawn.columns is not None else {"colors": colours}
    if not drawn.wire:
        return ARCHETYPES[drawn.kind].from_fields(**style, fill_mode="solid")
    lines = "radii" if drawn.kind == "boxes" else "line_radii"
    return ARCHETYPES[drawn.kind].from_fields(**style, fill_mode="majorwireframe", **{lines: 0.0006})


def _solids(drawn: Primitives, part: Part) -> dict[str, np.ndarray]:
    """Primitives over all frames, flat, as the columns of rerun's archetype of their kind."""
    positions, quaternions, sizes = part
    turned = {"quaternions": x_first(quaternions).reshape(-1, 4)}
    if drawn.kind in ("boxes", "ellipsoids"):
        return turned | {"centers": positions.reshape(-1, 3), "half_sizes": sizes.reshape(-1, 3)}
    radius, half = sizes[..., 0] * drawn.thinness, sizes[..., 1]
    long = {"radii": radius.ravel(), "lengths": 2 * half.ravel()}
    if drawn.kind == "cylinders":
        return turned | long | {"centers": positions.reshape(-1, 3)}
    begin = positions - _z_axes(quaternions) * half[..., None]  # rerun's capsules start at their origin
    return turned | long | {"translations": begin.reshape(-1, 3)}


def scene_views(eyes: tuple[Eye, Eye], pick: bool) -> dict[str, rrb.View]:
    """The views of an episode and of a robot on its way.

    Args:
        eyes: from where one looks at the scene, and at the robot.
        pick: whether it is a pick.
    """
    more = ("Episode: goal, trail, OSC target, contact forces", "; wireframes are what touches in the physics") if pick else ("Episode", "")
    return {"scene": robot_view(more[0], eyes[0]), "robot": robot_view(f"The robot on its way{more[1]}", eyes[1])}


def recorded_framing(chunks: Iterable[Chunk]) -> tuple[Eye, Eye] | None:
    """From where one looks at a recording's scene and at its robot; None if it does not say, as those of older versions."""
    for chunk in chunks:
        if chunk.entity_path == "/framing":
            row = chunk.to_record_batch().slice(0, 1).to_pylist()[0]
            eyes = np.array(row["Points3D:positions"]).reshape(2, 2, 3)
            return tuple(eyes[0]), tuple(eyes[1])
    return None


def _triangles(mesh: Mesh) -> rr.Mesh3D:
    return rr.Mesh3D(vertex_positions=mesh.vertices, vertex_normals=mesh.normals, vertex_colors=mesh.colours, triangle_indices=mesh.faces)


def _z_axes(quaternions: np.ndarray) -> np.ndarray:
    """(..., 3) unit vectors from quaternions (..., 4), w first."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)


def _seen(motion: Motion, users: list[int], robots: np.ndarray, faint: float) -> np.ndarray:
    """(T, n_users): which instances of a mesh are drawn; of two in the same place, as arms that robots share, one."""
    seen = motion.weights[:, robots] > faint
    for later in range(1, len(users)):
        for earlier in range(later):
            if robots[earlier] != robots[later]:
                apart = np.abs(motion.positions[:, users[earlier]] - motion.positions[:, users[later]]).max(axis=1)
                seen[:, later] &= ~(seen[:, earlier] & (apart < 1e-3))
    return seen


def _poses(positions: np.ndarray, quaternions: np.ndarray, lengths: np.ndarray | None = None) -> rr.ComponentColumnList:
    """Instance poses per frame: (T, n, 3) and (T, n, 4), or flat with the number of instances of each frame."""
    if lengths is None:
        lengths = np.full(positions.shape[0], positions.shape[1])
    turns = x_first(quaternions).reshape(-1, 4)
    return rr.InstancePoses3D.columns(translations=positions.reshape(-1, 3), quaternions=turns).partition(lengths)
