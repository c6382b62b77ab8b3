"""tree: of anybody's points and of the robots, as JSON, in words and as a picture."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import POINTS, answer, refusal

from toolkit.cli import main
from toolkit.cli.names import TARGETS

pytestmark = pytest.mark.usefixtures("at_home")


def check_tree(found, source, targets):
    """The contract of `tree --json`, and that it is a tree which joins them all."""
    keys = {"metric", "kind", "length", "optimal", "lower_bound", "nodes", "edges"}
    assert keys <= found.keys(), keys - found.keys()
    kinds = {node["name"]: node["kind"] for node in found["nodes"]}
    assert [name for name, kind in kinds.items() if kind == "source"] == [source]
    assert {name for name, kind in kinds.items() if kind == "target"} == set(targets)
    assert set(kinds.values()) <= {"source", "target", "meta"} and len(found["edges"]) == len(kinds) - 1
    alpha = {node["name"]: np.array(node["alpha"]) for node in found["nodes"]}
    for edge in found["edges"]:
        order = 1 if found["metric"] == "l1" else 2
        assert edge["length"] == pytest.approx(np.linalg.norm(alpha[edge["to"]] - alpha[edge["from"]], order), abs=1e-9)
    assert {edge["to"] for edge in found["edges"]} == set(kinds) - {source}
    assert found["length"] == pytest.approx(sum(edge["length"] for edge in found["edges"]))


@pytest.mark.parametrize("kind", ["steiner", "geometric-median", "independent"])
@pytest.mark.parametrize("metric", ["l1", "l2"])
def test_a_tree_of_points(capsys, points, kind, metric):
    found = answer(capsys, "tree", "--points", points, "--kind", kind, "--metric", metric)
    assert (found["kind"], found["metric"]) == (kind, metric)
    check_tree(found, "hand", ["left", "right"])


def test_a_tree_in_words_and_as_a_picture(capsys, points):
    main(["tree", "--points", points, "--plot", "tree.png"])
    out, _ = capsys.readouterr()
    assert "proven shortest" in out and "ratio 1.52" in out
    assert Path("tree.png").read_bytes().startswith(b"\x89PNG")


def test_a_tree_of_points_as_its_targets_join(capsys, points):
    found = answer(capsys, "tree", "--points", points, "--growth")
    assert [cost["length"] for cost in found["growth"]] == pytest.approx([1.6, 2.3]) and found["length"] == pytest.approx(2.3)
    assert "leave out --points or --arms" in refusal(capsys, "tree", "--points", points, "--arms")
    assert "effort is -1" in refusal(capsys, "tree", "--points", points, "--effort", "-1")
    main(["tree", "--points", points, "--growth"])
    assert "Targets joining one by one" in capsys.readouterr().out


def test_truncated_points_are_refused(capsys, points):
    Path(points).write_text(json.dumps(POINTS)[:60])
    assert refusal(capsys, "tree", "--points", points).startswith("points.json is not JSON")


@pytest.mark.parametrize(
    "text, said",
    [("[]", "points.json"), ('{"source": {"name": "a", "alpha": [0, 2]}, "targets": [{"name": "b", "alpha": [0, 1]}]}', "alpha[1]"),
     ('{"source": {"name": "a", "alpha": [0]}, "targets": []}', "list at least one robot"), (None, "cannot be read")],
)
def test_other_points_are_refused(capsys, points, text, said):
    if text is None:
        Path(points).unlink()
    else:
        Path(points).write_text(text)
    assert said in refusal(capsys, "tree", "--points", points)


def test_a_picture_of_an_unknown_kind_is_refused(capsys, points):
    assert "name a .png or .svg file" in refusal(capsys, "tree", "--points", points, "--plot", "tree.foo")


def test_the_tree_of_the_robots(capsys, monkeypatch, space):
    """With what the tree would cost for the hand on the other arms, and as the targets join."""
    import toolkit.morphology.survey

    made = []

    def as_points(robots, task=None):
        made.append([robot.name for robot in robots])
        points = {name: toolkit.morphology.survey.Terminal(name, space.beta(name)) for name in space.matching.names}
        # the hand on another arm stands where the source does, a little aside
        return [points.get(r.name, toolkit.morphology.survey.Terminal(r.name, 0.9 * points["adroit"].alpha + 0.05)) for r in robots]

    monkeypatch.setattr(toolkit.morphology.survey, "as_points", as_points)
    found = answer(capsys, "tree", "--arms", "--growth")
    check_tree(found, "adroit", TARGETS)
    assert found["optimal"] and all(len(node["alpha"]) == space.size for node in found["nodes"])
    assert made == [["adroit", *TARGETS], ["adroit", "adroit_on_jaco", "adroit_on_iiwa", *TARGETS]]
    lengths = [cost["length"] for cost in found["arms"]]
    assert lengths == sorted(lengths) and {cost["arm"] for cost in found["arms"]} == {"Kinova3", "Jaco", "IIWA"}
    assert [cost["targets"] for cost in found["growth"]] == [list(TARGETS[:1]), list(TARGETS[:2]), list(TARGETS)]
    assert found["growth"][-1]["length"] == found["length"]
