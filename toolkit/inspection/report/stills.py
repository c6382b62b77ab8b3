"""Robots rendered off screen by MuJoCo: one robot fading into another, and what they carry where."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from toolkit.errors import ToolkitError
from toolkit.inspection.appearance import geom_colour
from toolkit.inspection.furniture import opacity
from toolkit.inspection.visual import ALWAYS, SHAPE, ArmVisual, ModelVisual, Motion, Visual
from toolkit.io.quoting import plain
from toolkit.morphology.family import MergedModel

CAMERA = {"lookat": (-0.27, 0.0, 1.15), "distance": 1.35, "azimuth": 125.0, "elevation": -18.0}
"""Where the picture is taken from: [m], [m], [deg], [deg]."""
LINED_UP = 280, 280
"""Width and height [pixels] of each of the robots that are lined up."""
SKY, AMBIENT, DIFFUSE = [0.86, 0.88, 0.91], 0.45, 0.55
"""Colour of the background, and brightness of the camera's own light."""
GOAL = (0.0, 0.62, 0.45, 0.35)


class _Camera:
    """MuJoCo's renderer, off screen.

    Args:
        model: that is drawn.
        size: width and height [pixels].

    Raises:
        ToolkitError: no off-screen rendering here.
    """

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int]) -> None:
        self.size = size
        self._model, self._data = model, mujoco.MjData(model)
        self._gl = _context(*size)
        self._gl.make_current()
        self._render = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._render)
        self._scene = mujoco.MjvScene(model, maxgeom=2000)
        self._camera, self._option = mujoco.MjvCamera(), mujoco.MjvOption()

    def _taken(self) -> np.ndarray:
        """Picture (height, width, 3), 0 to 255, of the data as they are."""
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, self._data, self._option, None, self._camera, everything, self._scene)
        picture = np.empty((self.size[1], self.size[0], 3), np.uint8)
        view = mujoco.MjrRect(0, 0, *self.size)
        mujoco.mjr_render(view, self._scene, self._render)
        mujoco.mjr_readPixels(picture, None, view, self._render)
        return picture[::-1]

    def close(self) -> None:
        """Free the graphics context."""
        self._render.free()
        self._gl.free()


class ArmRenderer(_Camera):
    """Takes pictures of arms with grippers at their table.

    Args:
        visual: of the merged robot.
        size: width and height [pixels].

    Raises:
        ToolkitError: no off-screen rendering here.
    """

    def __init__(self, visual: ArmVisual, size: tuple[int, int] = (360, 360)) -> None:
        super().__init__(_arm_model(visual), size)
        self.visual, self.instances = visual, visual.appearance.instances
        self._drawn = [self._model.geom(f"instance{k}").id for k in range(len(self.instances))]
        self._camera.lookat[:] = CAMERA["lookat"]
        self._camera.distance, self._camera.azimuth, self._camera.elevation = CAMERA["distance"], CAMERA["azimuth"], CAMERA["elevation"]

    def take(self, alpha: np.ndarray) -> np.ndarray:
        """Picture (height, width, 3), 0 to 255, of the robot alpha (D,) at the start posture."""
        motion = self.visual.standing([alpha])
        return self.draw(motion.positions[0], motion.quaternions[0], motion.weights[0])

    def shot(self, motion: Motion, frame: int, goal: np.ndarray | None) -> np.ndarray:
        """Picture of a frame of a motion; of an episode with its object and its goal (3,) [m], else with the object where it begins."""
        carried = None if goal is None or motion.carried is None else motion.carried[frame]
        return self.draw(motion.positions[frame], motion.quaternions[frame], motion.weights[frame], carried, goal)

    def draw(
        self, positions: np.ndarray, quaternions: np.ndarray, weights: np.ndarray, carried: np.ndarray | None = None,
        goal: np.ndarray | None = None,
    ) -> np.ndarray:
        """Picture (height, width, 3), 0 to 255.

        Args:
            positions, quaternions: (n_instances, 3) [m] and (n_instances, 4), w first, of all instances, world.
            weights: (n_robots,) how much of each robot shows.
            carried: (7,) position [m] and quaternion of the object, world; None: where it begins.
            goal: (3,) [m] where it should be; None: not shown.
        """
        thing = self.visual.merged.template.body("object")
        self._data.mocap_pos[-2] = thing.pos if carried is None else carried[:3]
        self._data.mocap_quat[-2] = thing.quat if carried is None else carried[3:]
        self._data.mocap_pos[-1] = 0.0 if goal is None else goal
        self._model.geom_rgba[self._model.geom("goal").id, 3] = 0.0 if goal is None else 0.35
        drawn: list[int] = []
        shares = np.zeros(len(self.instances))
        for k, item in enumerate(self.instances):
            self._data.mocap_pos[k], self._data.mocap_quat[k] = positions[k], quaternions[k]
            twins = [j for j in drawn if self.instances[j].mesh == item.mesh and self.instances[j].robot != item.robot
                     and np.abs(positions[j] - positions[k]).max() < 1e-3]
            shares[k] = weights[item.robot]
            if twins:  # arms that robots share: one picture, with the weight of both
                shares[twins[0]] += shares[k]
                shares[k] = 0.0
            drawn.append(k)
        self._model.geom_rgba[self._drawn, 3] = opacity(shares, weights.max())
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        return self._taken()


class ModelRenderer(_Camera):
    """Takes pictures of robots of a family in their task's scene.

    Args:
        visual: of the merged robot.
        size: width and height [pixels].
        near: look at the robot, and not at the whole scene.

    Raises:
        ToolkitError: no off-screen rendering here.
    """

    def __init__(self, visual: ModelVisual, size: tuple[int, int] = (360, 360), near: bool = True) -> None:
        model = _lit_model(visual.merged, size)
        super().__init__(model, size)
        self.visual = visual
        self._colours = {geom: geom_colour(model, geom) / 255 for geom, column in visual.geoms.items() if column != ALWAYS}
        for geom, column in visual.geoms.items():
            if column == SHAPE:
                model.geom_group[geom], self._colours[geom][3] = 0, 1.0
        eye, point = visual.framing.near if near else visual.framing.whole
        forward = point - eye
        self._camera.lookat[:], self._camera.distance = point, np.linalg.norm(forward)
        self._camera.azimuth = np.degrees(np.arctan2(forward[1], forward[0]))
        self._camera.elevation = np.degrees(np.arctan2(forward[2], np.hypot(forward[0], forward[1])))
        mujoco.mj_kinematics(model, self._data)
        mujoco.mj_camlight(model, self._data)

    def take(self, alpha: np.ndarray) -> np.ndarray:
        """Picture (height, width, 3), 0 to 255, of the robot alpha (D,) where the episode of seed 0 begins."""
        return self.shot(self.visual.standing([alpha]), 0, None)

    def shot(self, motion: Motion, frame: int, goal: np.ndarray | None) -> np.ndarray:
        """Picture of a frame of a motion; a goal that the task has is one of the model's sites."""
        self.visual.pose(motion, frame, self._model, self._data)
        shares = opacity(motion.weights[frame], motion.weights[frame].max())
        for geom, colour in self._colours.items():
            self._model.geom_rgba[geom] = (*colour[:3], colour[3] * shares[self.visual.geoms[geom]])
        return self._taken()


def renderer_of(visual: Visual, size: tuple[int, int] = (360, 360), near: bool = True) -> ArmRenderer | ModelRenderer:
    """Takes pictures of whatever robots there are; ``near``, of robots of a family, as of ModelRenderer."""
    if isinstance(visual, ArmVisual):
        return ArmRenderer(visual, size)
    if isinstance(visual, ModelVisual):
        return ModelRenderer(visual, size, near)
    raise TypeError(f"no renderer draws a {type(visual).__name__}")


def write_on(picture: Image.Image, place: tuple[int, int], text: str, size: int) -> None:
    """Write a line at a place [pixels], dark with a rim of the background's colour, so that it is read on dark ground too."""
    rim = tuple(round(255 * part) for part in SKY)
    ImageDraw.Draw(picture).text(place, plain(text), fill=(25, 28, 34), font=ImageFont.load_default(size=size), stroke_width=3,
                                 stroke_fill=rim)


def line_up(visual: Visual, names: Sequence[str], betas: np.ndarray, out: Path) -> None:
    """Draw robots side by side, each with its name, into a PNG.

    Args:
        visual: of the merged robot.
        names, betas: of the robots, (n_robots, D).
        out: the file.

    Raises:
        ToolkitError: no off-screen rendering here, or the file cannot be written.
    """
    renderer = renderer_of(visual, LINED_UP)
    try:
        row = Image.fromarray(np.concatenate([renderer.take(beta) for beta in betas], axis=1))
    finally:
        renderer.close()
    for k, name in enumerate(names):
        write_on(row, (k * LINED_UP[0] + 10, 8), name, 17)
    try:
        row.quantize(128).save(out)
    except OSError as error:
        raise ToolkitError(f"{out} cannot be written ({error.strerror or error}); free space there, or choose another place") from None


def _arm_model(visual: ArmVisual) -> mujoco.MjModel:
    """Every instance on a body that can be put anywhere; a table, the object, a light background."""
    merged, appearance = visual.merged, visual.appearance
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [AMBIENT] * 3, [DIFFUSE] * 3
    spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
                     rgb1=SKY, rgb2=SKY, width=64, height=384)
    for index, mesh in enumerate(appearance.meshes):
        asset = spec.add_mesh(name=f"mesh{index}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        asset.uservert, asset.userface = mesh.vertices.ravel(), mesh.faces.ravel().astype(int)
    for k, item in enumerate(appearance.instances):
        colour = appearance.meshes[item.mesh].colours.mean(axis=0) / 255
        body = spec.worldbody.add_body(name=f"instance{k}", mocap=True)
        body.add_geom(name=f"instance{k}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"mesh{item.mesh}", contype=0, conaffinity=0,
                      rgba=colour)
    for mesh in visual.scenery:
        asset = spec.add_mesh(name=mesh.name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        asset.uservert, asset.userface = mesh.vertices.ravel(), mesh.faces.ravel().astype(int)
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, contype=0, conaffinity=0,
                                rgba=mesh.colours.mean(axis=0) / 255)
    thing = visual.carried
    asset = spec.add_mesh(name="object", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    asset.uservert, asset.userface = thing.vertices.ravel(), thing.faces.ravel().astype(int)
    spec.worldbody.add_body(name="object", mocap=True).add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname="object", contype=0, conaffinity=0, rgba=thing.colours.mean(axis=0) / 255)
    spec.worldbody.add_body(name="goal", mocap=True).add_geom(
        name="goal", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[merged.task.goal_tolerance, 0, 0], contype=0, conaffinity=0, rgba=GOAL)
    spec.worldbody.add_light(pos=[0.6, -1.0, 2.6], dir=[-0.3, 0.4, -1.0], castshadow=False)
    return spec.compile()


def _lit_model(merged: MergedModel, size: tuple[int, int]) -> mujoco.MjModel:
    """The source in its scene before a light background; with a light of the camera's where the scene has none."""
    spec = merged.task.spec(merged.space.robots[0])
    spec.visual.global_.offwidth, spec.visual.global_.offheight = size
    sky = mujoco.mjtTexture.mjTEXTURE_SKYBOX
    for texture in [texture for texture in spec.textures if texture.type == sky]:
        spec.delete(texture)
    spec.add_texture(name="sky", type=sky, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT, rgb1=SKY, rgb2=SKY, width=64, height=384)
    if not spec.lights:
        spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [AMBIENT] * 3, [DIFFUSE] * 3
    model = spec.compile()
    model.geom_type[:] = merged.template.geom_type  # spheres that grow into capsules
    return model


def _context(width: int, height: int) -> Any:
    """The first graphics context that works without a screen."""
    asked = os.environ.get("MUJOCO_GL", "").lower()
    problems = []
    for name in [asked] if asked in ("egl", "osmesa") else ["egl", "osmesa"]:
        try:
            return _maker(name)(width, height)
        except (ImportError, RuntimeError, AttributeError, OSError) as error:
            problems.append(f"{name}: {error}")
    raise ToolkitError(f"no off-screen rendering here ({'; '.join(problems)}); `meta-evolve doctor` says how to mend it")


def _maker(name: str) -> Callable[[int, int], Any]:
    if name == "egl":
        from mujoco.egl import GLContext
    else:
        from mujoco.osmesa import GLContext
    return GLContext
