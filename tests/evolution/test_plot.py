"""The tree's picture."""

import numpy as np
import pytest
from toy_trees import tree_of

from toolkit.errors import ToolkitError
from toolkit.evolution import plot_tree


def test_plot(tmp_path):
    tree = tree_of(np.random.default_rng(16).random((6, 10)))
    plot_tree(tree, tmp_path / "tree.png")
    assert (tmp_path / "tree.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ToolkitError, match="cannot be written"):
        plot_tree(tree, tmp_path / "tree.xyz")
