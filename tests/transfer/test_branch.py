"""Branches: each owns its policy and its random numbers, and is called by where it comes from."""

import numpy as np
import pytest
from toy_transfer import META, SOURCE, THREE, Toy, config, easy_toy, records, transfer_of

from toolkit.evolution import evolution_tree
from toolkit.inspection.drawn_tree import Plan
from toolkit.transfer.branch import path_generator

pytestmark = pytest.mark.usefixtures("unhurried")


def test_siblings_own_their_policies(tmp_path):
    transfer = transfer_of(tmp_path / "run", config(), Toy())
    branch = transfer.pending[0]
    branch.alpha = META
    second, first = transfer.split(branch, transfer.way.evolution_tree(branch))
    networks = [network for b in (first, second, branch) for network in (b.policy, b.value)]
    before = [network.parameters.copy() for network in networks]
    for changed in range(2):
        networks[changed].set_parameters(before[changed] + 1.0)
        networks[changed].set_normalisation(np.full(1, 3.0), np.full(1, 2.0))
    for i in range(2, 6):
        np.testing.assert_array_equal(networks[i].parameters, before[i])
        assert float(networks[i].layers().shift[0]) == 0.0
    transfer.frontier.replace(branch, [second, first])
    assert [branch.targets for branch in transfer.pending] == [["right"], ["left"]], "the first target goes first"


def test_every_path_has_random_numbers_of_its_own():
    """By its name and the seed alone; NumPy pads what it is seeded with by zeros, which must not make a path its rival's twin."""
    names = ["path 1", "path 1.0", "path 1.1", "path 1.1.0", "path 1.2", "path 1.11", "path 1.1.1"]
    drawn = {(seed, name): path_generator(seed, name).integers(2**62) for seed in (0, 1) for name in names}
    assert len(set(drawn.values())) == len(drawn)
    assert path_generator(1, "path 1.1").integers(2**62) == drawn[1, "path 1.1"]


@pytest.mark.parametrize("kind", ["steiner", "independent"])
def test_the_drawn_tree_names_the_paths_of_the_transfer(tmp_path, kind):
    """Fixed steps do not look ahead, so that no target leaves the tree before its turn."""
    transfer = transfer_of(tmp_path / "run", config(kind=kind, step="fixed", xi=0.5), easy_toy(), targets=THREE)
    transfer.meta_evolve()
    plan, told = Plan(evolution_tree(SOURCE, THREE, kind=kind).to_json()), dict.fromkeys(record["path"] for record in records(transfer))
    assert plan.paths == [path for path in transfer.costs if path in told]
