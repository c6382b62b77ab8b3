"""What is drawn of a robot: shapes where MuJoCo has them, films that keep what a scene has placed, meshes that fade where shapes change."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from toys import HAND_ROBOTS, LIFT

import robots
import tasks
from toolkit.expert.training import new_learner
from toolkit.inspection.furniture import opacity
from toolkit.inspection.trajectory import PickTrajectory, replay
from toolkit.inspection.visual import ALWAYS, SHAPE, SKIN, visual_of
from toolkit.learning.policy import MeanActor
from toolkit.morphology.lab import Lab
from toolkit.simulation.laws import merged_plant, native_plant


@pytest.fixture(scope="module")
def hands():
    """gymnasium-robotics' ADROIT at its door, and the hand of two fingers: links whose meshes cannot shrink with them."""
    task = tasks.MODEL_TASKS["door"]
    source, target = (robots.MODEL_ROBOTS[name] for name in ("adroit-free", "two-finger"))
    return Lab(source, [target], task)


def test_boxes_and_balls_of_another_task():
    """The toy hand lifts: a box, two capsules, a ball, over every frame of a film against mj_kinematics."""
    lab = Lab(HAND_ROBOTS[0], HAND_ROBOTS[1:], LIFT)
    visual, alpha = visual_of(lab.merged), lab.space.betas[1]
    actor = MeanActor(new_learner(LIFT, 0)[0])
    film = replay(merged_plant(lab.merged, alpha, *lab.merged.new()), actor, 3, alpha)
    assert not isinstance(film, PickTrajectory) and {name: len(drawn.colours) for name, drawn in visual.primitives.items()} == {
        "boxes": 1, "capsules": 2, "ellipsoids": 2}, "the palm, two fingers, the ball and a site"
    motion = visual.playing(film, alpha)
    model, data = lab.merged.new()
    lab.merged.become(alpha, model, data)
    for frame in range(0, len(film.qpos), 7):
        data.qpos[:] = film.qpos[frame]
        mujoco.mj_kinematics(model, data)
        for name, geoms in (("boxes", ["palm"]), ("capsules", ["thumb", "finger"]), ("ellipsoids", ["ball"])):
            places, turns, sizes = (array[frame][: len(geoms)] for array in motion.parts[name])
            ids = [model.geom(geom).id for geom in geoms]
            np.testing.assert_allclose(places, data.geom_xpos[ids], atol=1e-9)
            matrices = Rotation.from_quat(turns, scalar_first=True).as_matrix().reshape(-1, 9)
            np.testing.assert_allclose(matrices, data.geom_xmat[ids], atol=1e-9)
            own = np.full((1, 3), 0.03) if name == "ellipsoids" else model.geom_size[ids]
            np.testing.assert_allclose(sizes, own, atol=1e-12)
        np.testing.assert_allclose(motion.parts["ellipsoids"][0][frame, 1], data.site("tip").xpos, atol=1e-9)


def test_a_film_keeps_what_the_scene_has_placed(hands):
    """The door stands elsewhere in each episode, by no joint: a film that is drawn after a later episode stands where it stood."""
    visual, actor = visual_of(hands.merged), MeanActor(new_learner(hands.task, 0)[0])
    plant = native_plant(hands.targets[0], hands.task)
    films, places = [], []
    for seed in (1, 2):
        films.append(replay(plant, actor, seed, hands.space.betas[1]))
        places.append(np.array(plant.data.xpos[plant.model.body("frame").id]))
    assert np.abs(places[0] - places[1]).max() > 0.01, "the seeds place the door alike"
    model = hands.merged.template
    frame = np.flatnonzero(model.geom_bodyid == model.body("frame").id)
    cylinders = [geom for geom in visual.geoms if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CYLINDER]
    for film, place in zip(films, places, strict=True):
        posts = visual.native(film, hands.targets[0].name).parts["cylinders"][0][0, [cylinders.index(geom) for geom in frame]]
        np.testing.assert_allclose(posts, place + model.geom_pos[frame], atol=1e-9)


def test_meshes_fade_where_shapes_change_and_nowhere_else(hands):
    """Of a finger that shrinks the mesh gives way to what touches; the forearm, which stays, keeps its mesh."""
    visual, model = visual_of(hands.merged), hands.merged.template
    column = {model.geom(geom).name: own for geom, own in visual.geoms.items()}
    assert column["V_ffproximal"] == SKIN and column["C_ffproximal"] == SHAPE and column["V_forearm"] == ALWAYS
    assert column["V_ffknuckle"] == SKIN and column["V_wrist"] == ALWAYS, "a knuckle, which touches nothing, goes with the palm"
    assert "C_forearm1" not in column, "what only touches stays hidden where a mesh shows it"
    motion = visual.standing(hands.space.betas)
    shown = opacity(motion.weights, motion.weights.max(axis=1, keepdims=True))
    np.testing.assert_array_equal(shown, [[1, 0, 1], [0, 1, 1]])
