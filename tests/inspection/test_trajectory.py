"""Films: an episode played again is the episode, and contacts push as MuJoCo says."""

import mujoco
import numpy as np
import pytest

from toolkit.inspection.trajectory import contacts_of, replay
from toolkit.learning.policy import MeanActor
from toolkit.simulation.laws import merged_plant
from toolkit.simulation.rollout import play


def test_a_film_is_the_episode_again(pair, policy):
    """Same policy, robot and seed: the same actions, bit by bit; contact forces hold the object against gravity."""
    beta = pair.merged.space.betas[0]
    actor = MeanActor(policy)
    played = play(merged_plant(pair.merged, beta, *pair.merged.new()), actor, 11, beta)
    film = replay(merged_plant(pair.merged, beta, *pair.merged.new()), actor, 11, beta)
    np.testing.assert_array_equal(film.actions, played.actions)
    assert film.success == played.success and film.verdict().startswith("success")
    assert len(film.qpos) == played.steps + 1 == len(film.target) + 1
    lifted = film.carried[1:, 2] - film.carried[0, 2] > 0.05
    weight = film.model.body_mass[film.object_body] * 9.81
    upward = np.array([force[:, 2].sum() for force in film.forces])
    assert lifted.sum() > 10
    assert np.median(upward[lifted]) == pytest.approx(weight, rel=0.25), "what carries the object is its weight"
    assert all(robot.all() for robot, up in zip(film.by_robot, lifted, strict=True) if up), "in the air only the robot touches it"
    reached = np.linalg.norm(film.target - film.grasp[1:], axis=1)
    assert reached.max() < 0.09, f"OSC's target is at most one step ahead, {reached.max():.3f} m"


def test_contacts_push_a_resting_box_up():
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1])
    box = spec.worldbody.add_body(name="box", pos=[0, 0, 0.05])
    box.add_freejoint()
    box.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.05] * 3, mass=2.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 500)
    points, forces, moving = contacts_of(model, data, model.body("box").id)
    assert len(points) == 4 and not moving.any() and np.abs(points[:, 2]).max() < 1e-3
    np.testing.assert_allclose(forces.sum(axis=0), [0, 0, 2.0 * 9.81], atol=1e-3)
