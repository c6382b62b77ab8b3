"""The picture of the merged tree: every robot in its colour."""

import matplotlib.image
import numpy as np
import pytest

from toolkit.errors import ToolkitError
from toolkit.inspection.merged_tree import COLOURS, plot_merged_tree


def test_the_merged_tree_is_drawn(matching, tmp_path):
    plot_merged_tree(matching, tmp_path / "tree.png")
    image = matplotlib.image.imread(tmp_path / "tree.png")[..., :3]
    for colour in COLOURS[: len(matching.names)]:
        rgb = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        share = float((np.abs(image - rgb) < 0.02).all(axis=2).mean())
        assert share > 0.001, f"{colour} covers {share:.2%} of the picture"


def test_an_unknown_picture_format_is_one_sentence(matching, tmp_path):
    with pytest.raises(ToolkitError, match=r"name a \.png or \.svg file"):
        plot_merged_tree(matching, tmp_path / "tree.nonsense")
