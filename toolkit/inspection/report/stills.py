"""Robots rendered off screen by MuJoCo: what the merged robot wears, one robot fading into another, and what they carry where."""

import os
from collections.abc import Callable

import mujoco
import numpy as np

from toolkit.errors import ToolkitError
from toolkit.inspection.appearance import Wardrobe, body_mesh
from toolkit.inspection.furniture import furniture, opacity
from toolkit.morphology.build import MergedRobot

CAMERA = {"lookat": (-0.27, 0.0, 1.15), "distance": 1.35, "azimuth": 125.0, "elevation": -18.0}
"""Where the picture is taken from: [m], [m], [deg], [deg]."""

GOAL = (0.0, 0.62, 0.45, 0.35)


class Studio:
    """Takes pictures of F(alpha) at the start posture.

    Args:
        merged: the merged robot.
        wardrobe: what it wears.
        size: width and height [pixels].

    Raises:
        ToolkitError: no off-screen rendering here.
    """

    def __init__(self, merged: MergedRobot, wardrobe: Wardrobe, size: tuple[int, int] = (360, 360)) -> None:
        self.merged, self.wardrobe, self.size = merged, wardrobe, size
        self._model = _studio_model(merged, wardrobe)
        self._data = mujoco.MjData(self._model)
        self._links = [merged.template.body(slot.name).id for slot in merged.space.matching.slots]
        self._robot, self._robot_data = merged.new()
        self._worn = [self._model.geom(f"worn{k}").id for k in range(len(wardrobe.worn))]
        self._gl = _context(*size)
        self._gl.make_current()
        self._render = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._render)
        self._scene = mujoco.MjvScene(self._model, maxgeom=2000)
        self._camera, self._option = mujoco.MjvCamera(), mujoco.MjvOption()
        self._camera.lookat[:] = CAMERA["lookat"]
        self._camera.distance, self._camera.azimuth, self._camera.elevation = CAMERA["distance"], CAMERA["azimuth"], CAMERA["elevation"]

    def take(self, alpha: np.ndarray) -> np.ndarray:
        """Picture (height, width, 3), 0 to 255, of the robot alpha (D,)."""
        self.merged.become(alpha, self._robot, self._robot_data)
        mujoco.mj_kinematics(self._robot, self._robot_data)
        return self.draw(*self.wardrobe.poses(self._robot_data, self._links), self.wardrobe.weights(alpha, self.merged.space.betas))

    def draw(
        self, positions: np.ndarray, quaternions: np.ndarray, weights: np.ndarray, carried: np.ndarray | None = None,
        goal: np.ndarray | None = None,
    ) -> np.ndarray:
        """Picture (height, width, 3), 0 to 255.

        Args:
            positions, quaternions: (n_worn, 3) [m] and (n_worn, 4), w first, of everything worn, world.
            weights: (n_robots,) how much of each robot shows.
            carried: (7,) position [m] and quaternion of the object, world; None: where it begins.
            goal: (3,) [m] where it should be; None: not shown.
        """
        thing = self.merged.template.body("object")
        self._data.mocap_pos[-2] = thing.pos if carried is None else carried[:3]
        self._data.mocap_quat[-2] = thing.quat if carried is None else carried[3:]
        self._data.mocap_pos[-1] = 0.0 if goal is None else goal
        self._model.geom_rgba[self._model.geom("goal").id, 3] = 0.0 if goal is None else 0.35
        drawn: list[int] = []
        shares = np.zeros(len(self.wardrobe.worn))
        for k, item in enumerate(self.wardrobe.worn):
            self._data.mocap_pos[k], self._data.mocap_quat[k] = positions[k], quaternions[k]
            twins = [j for j in drawn if self.wardrobe.worn[j].mesh == item.mesh and self.wardrobe.worn[j].robot != item.robot
                     and np.abs(positions[j] - positions[k]).max() < 1e-3]
            shares[k] = weights[item.robot]
            if twins:  # arms that robots share: one picture, with the weight of both
                shares[twins[0]] += shares[k]
                shares[k] = 0.0
            drawn.append(k)
        self._model.geom_rgba[self._worn, 3] = opacity(shares, weights.max())
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
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


def _studio_model(merged: MergedRobot, wardrobe: Wardrobe) -> mujoco.MjModel:
    """Every worn mesh on a body that can be put anywhere; a table, the object, a light background."""
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.visual.headlight.ambient = [0.45, 0.45, 0.45]
    spec.visual.headlight.diffuse = [0.55, 0.55, 0.55]
    spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
                     rgb1=[0.86, 0.88, 0.91], rgb2=[0.86, 0.88, 0.91], width=64, height=384)
    for index, mesh in enumerate(wardrobe.meshes):
        asset = spec.add_mesh(name=f"mesh{index}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        asset.uservert, asset.userface = mesh.vertices.ravel(), mesh.faces.ravel().astype(int)
    for k, item in enumerate(wardrobe.worn):
        colour = wardrobe.meshes[item.mesh].colours.mean(axis=0) / 255
        body = spec.worldbody.add_body(name=f"worn{k}", mocap=True)
        body.add_geom(name=f"worn{k}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"mesh{item.mesh}", contype=0, conaffinity=0, rgba=colour)
    for mesh in furniture(merged.space.matching.systems[0].model):
        asset = spec.add_mesh(name=mesh.name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        asset.uservert, asset.userface = mesh.vertices.ravel(), mesh.faces.ravel().astype(int)
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, contype=0, conaffinity=0,
                                rgba=mesh.colours.mean(axis=0) / 255)
    thing = body_mesh(merged.template, merged.template.body("object").id)
    asset = spec.add_mesh(name="object", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    asset.uservert, asset.userface = thing.vertices.ravel(), thing.faces.ravel().astype(int)
    spec.worldbody.add_body(name="object", mocap=True).add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname="object", contype=0, conaffinity=0, rgba=thing.colours.mean(axis=0) / 255)
    spec.worldbody.add_body(name="goal", mocap=True).add_geom(
        name="goal", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[merged.task.goal_tolerance, 0, 0], contype=0, conaffinity=0, rgba=GOAL)
    spec.worldbody.add_light(pos=[0.6, -1.0, 2.6], dir=[-0.3, 0.4, -1.0], castshadow=False)
    return spec.compile()


def _context(width: int, height: int) -> object:
    """The first graphics context that works without a screen."""
    asked = os.environ.get("MUJOCO_GL", "").lower()
    problems = []
    for name in [asked] if asked in ("egl", "osmesa") else ["egl", "osmesa"]:
        try:
            return _maker(name)(width, height)
        except (ImportError, RuntimeError, AttributeError, OSError) as error:
            problems.append(f"{name}: {error}")
    raise ToolkitError(f"no off-screen rendering here ({'; '.join(problems)}); `meta-evolve doctor` says how to mend it")


def _maker(name: str) -> Callable[[int, int], object]:
    if name == "egl":
        from mujoco.egl import GLContext
    else:
        from mujoco.osmesa import GLContext
    return GLContext
