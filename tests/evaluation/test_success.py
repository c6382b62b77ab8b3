"""Evaluation: success on the unmodified robosuite robot, and the interval that is claimed for it."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robots import ROBOTS
from tasks.pick import ACTION, OBSERVATION
from toolkit.evaluation.success import Evaluation, evaluate_merged, evaluate_native
from toolkit.learning.policy import GaussianPolicy
from toolkit.simulation.rollout import RolloutEngine


def wilson(successes, episodes):
    """Wilson (1927): the rates p with |p - k/n| <= z sqrt(p (1 - p) / n), by hand."""
    z, rate = 1.959963984540054, successes / episodes
    centre = (rate + z * z / (2 * episodes)) / (1 + z * z / episodes)
    half = z / (1 + z * z / episodes) * math.sqrt(rate * (1 - rate) / episodes + z * z / (4 * episodes**2))
    return centre - half, centre + half


@given(episodes=st.integers(1, 500), share=st.floats(0, 1))
def test_the_interval_is_wilsons(episodes, share):
    successes = round(share * episodes)
    result = Evaluation("jaco", "native", episodes, successes, 0, 0)
    np.testing.assert_allclose(result.ci95, wilson(successes, episodes), atol=1e-9)
    assert result.ci95[0] <= result.success_rate <= result.ci95[1]


def test_the_interval_by_hand():
    """8 of 10: (0.490, 0.943)."""
    np.testing.assert_allclose(Evaluation("jaco", "native", 10, 8, 0, 0).ci95, (0.4901625, 0.9433178), atol=1e-6)


def test_json_keeps_its_contract():
    record = Evaluation("jaco", "merged", 4, 1, 2, 7).to_json()
    assert {k: record[k] for k in ("target", "env", "episodes", "successes", "success_rate", "diverged", "seed")} == {
        "target": "jaco", "env": "merged", "episodes": 4, "successes": 1, "success_rate": 0.25, "diverged": 2,
        "seed": 7,
    }
    assert len(record["ci95"]) == 2


@pytest.fixture(scope="module")
def idle():
    """A policy whose mean action is zero everywhere."""
    policy = GaussianPolicy(OBSERVATION.names, ACTION.names, np.random.default_rng(0))
    policy.set_parameters(np.zeros_like(policy.parameters))
    return policy


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_divergence_on_the_native_robot_is_counted(task, idle, processes):
    far = replace(task, horizon=3, noise_xy=1e14)  # an object beyond what MuJoCo takes for a number
    result = evaluate_native(idle, ROBOTS["kinova3"], far, 4, processes=processes)
    assert (result.successes, result.diverged) == (0, 4)
    assert evaluate_native(idle, ROBOTS["kinova3"], replace(task, horizon=3), 1).diverged == 0


def test_what_is_evaluated_is_what_was_given_not_what_had_its_name(task, idle):
    """Tasks and robots are told apart by all that they hold."""
    near = replace(task, goal_offset=(0.0, 0.0, 0.0), hold_steps=1)  # the object lies at its goal
    assert near.name == task.name
    found = [evaluate_native(idle, ROBOTS["kinova3"], what, 1).successes for what in (replace(task, horizon=2), near)]
    assert found == [0, 1]


@pytest.mark.slow
@pytest.mark.parametrize(("run", "target"), [("found-tree-0", "iiwa"), ("found-independent-0", "jaco"), ("found-independent-0", "kinova3")])
def test_what_picks_on_robosuites_gripper_picks_on_its_merged_robot(run, target, merged, task):
    """Policies in docs/results, 200 of 200 on the unmodified robot: F(beta) is that robot, so they pick there as well."""
    path = Path(__file__).parents[2] / "docs" / "results" / run / f"{target}.policy.safetensors"
    policy = GaussianPolicy.load(path, task.observation.names, task.action.names)
    engine = RolloutEngine(merged)
    found = evaluate_merged(policy, engine, target, 8)
    engine.close()
    assert found.successes >= 6, f"{found.successes} of 8"
