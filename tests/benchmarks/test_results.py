"""Results: every number of the page comes from the run folders, and an unfinished suite says so."""

import json
import re

import numpy as np
import pytest
from scipy.stats import binomtest

from toolkit.benchmarks.paper import PAPER
from toolkit.benchmarks.results import finished_runs, read_result, results_json, write_results
from toolkit.errors import ToolkitError
from toolkit.runs.run import Run


def finished(folder, name, seed, epochs, successes, kind="steiner", task="061_foam_brick", targets=("left", "right")):
    """A run folder as a transfer leaves it, with a path to each target."""
    run = Run.create(folder / name, {"targets": list(targets), "transfer": {"threshold": 0.66, "xi": 0.03}})
    evaluation = {"episodes": 200, "successes": successes, "success_rate": successes / 200, "ci95": [0.5, 0.97], "seed": 10**9}
    paths = {f"path {number}": epochs if number == 1 else 7 for number in range(1, len(targets) + 1)}
    for path in paths:
        run.append_metrics({"event": "check", "path": path, "stage": "evolve", "success": 0.75, "train_iterations": 3, "sim_epochs": 12,
                            "check_episodes": 16, "diverged": 0})
    nodes = [{"name": n, "kind": "target" if n != "hand" else "source", "alpha": [0.5]} for n in ("hand", *targets)]
    edges = [{"from": "hand", "to": n, "length": 1.5} for n in targets]
    run.write_json("tree", {"metric": "l1", "kind": kind, "length": 3.0, "nodes": nodes, "edges": edges})
    run.write_json("report", {
        "targets": {t: {"native": evaluation, "merged": evaluation | {"successes": 199}} for t in targets},
        "train_iterations": {path: 3 for path in paths}, "sim_epochs": paths, "check_episodes": {path: 16 for path in paths},
        "routes": {path: ["hand", target] for path, target in zip(paths, targets, strict=True)},
        "totals": {"train_iterations": 3 * len(paths), "sim_epochs": sum(paths.values()), "check_episodes": 16 * len(paths), "diverged": 0},
        "wall_s": 100.0,
        "time": {"wall_s": 90.0}, "seed": seed, "kind": kind, "metric": "l1", "step": "adaptive", "path": "straight", "task": task,
    })
    return run.path


def test_every_count_of_the_runs_is_on_the_page(tmp_path):
    suite = tmp_path / "suite"
    suite.mkdir()
    finished(suite, "tree-0", 0, 1001, 187)
    finished(suite, "tree-1", 1, 2002, 163)
    finished(suite, "alone-0", 0, 4111, 151, kind="independent")
    page = write_results(suite, "A suite", "make results", PAPER["real-robots"])
    text = page.read_text()
    for count in (187, 163, 151, 199):
        assert f"{count} of 200" in text
    mean, deviation = np.mean([1008, 2009]), np.std([1008, 2009], ddof=1)
    row = rf"\| tree, L1, adaptive step, to left, right \| 061_foam_brick \| 2 \| .*\| {mean:.0f} ± {deviation:.0f} \|"
    assert re.search(row, text), text
    assert "| alone-0 | path 1: hand to left | 3 | 4111 | 16 |" in text
    assert "make results" in text and str(PAPER["real-robots"][0].sim_epochs[0]) in text
    for picture in re.findall(r"\((suite/\w+\.png)\)", text):
        assert (tmp_path / picture).read_bytes().startswith(b"\x89PNG")


def test_a_tree_is_compared_with_the_independent_paths_to_its_own_targets(tmp_path):
    suite = tmp_path / "suite"
    suite.mkdir()
    finished(suite, "tree-0", 0, 1000, 187)  # 1007 epochs, 6 iterations
    finished(suite, "alone-0", 0, 2007, 151, kind="independent")
    finished(suite, "alone-1", 1, 2013, 151, kind="independent")
    finished(suite, "alone-three", 0, 2007, 151, kind="independent", targets=("left", "right", "up"))  # seed 0 went left the same way
    finished(suite, "other-task", 0, 5, 151, task="another")
    text = write_results(suite, "A suite", "make results").read_text()
    assert f"| tree-0 | left, right | 6 | 6 | 1.00 | 1007 | {2010 + 7} | {2017 / 1007:.2f} |" in text
    assert "| other-task | left, right | 6 |" not in text  # nobody went there alone


def test_the_cost_grows_with_the_targets_that_trees_share(tmp_path):
    suite = tmp_path / "suite"
    suite.mkdir()
    names = ("left", "right", "up")
    finished(suite, "alone-0", 0, 500, 190, kind="independent", targets=names)
    finished(suite, "alone-1", 1, 600, 190, kind="independent", targets=names)
    for count, epochs in ((1, 550), (2, 493), (3, 386)):
        finished(suite, f"tree-{count}", 0, epochs, 190, targets=names[:count])
    finished(suite, "elsewhere", 0, 9, 190, targets=("up", "left"))  # not the first ones of the longest set
    finished(suite, "another", 0, 9, 190, targets=("down", "right", "up"))  # as many, but nothing grew to them
    text = write_results(suite, "A suite", "make results").read_text()
    method = "| tree, L1, adaptive step | 061_foam_brick"
    assert f"{method} | 1, to left | 550 | 550 | 1.00 |" in text
    assert f"{method} | 2, to right | 500 | 557 | 1.11 |" in text
    assert f"{method} | 3, to up | 400 | 564 | 1.41 |" in text
    assert (suite / "growth.png").read_bytes().startswith(b"\x89PNG") and "(suite/growth.png)" in text
    assert "to left | 9 |" not in text


def test_two_sets_of_targets_are_no_growth(tmp_path):
    suite = tmp_path / "suite"
    suite.mkdir()
    finished(suite, "alone-0", 0, 500, 190, kind="independent")
    finished(suite, "tree-1", 0, 550, 190, targets=("left",))
    finished(suite, "tree-2", 0, 493, 190)
    assert "Growth" not in write_results(suite, "A suite", "make results").read_text() and not (suite / "growth.png").exists()


def test_json_says_what_the_page_says(tmp_path):
    suite = tmp_path / "suite"
    suite.mkdir()
    for name, seed, epochs, successes, kind in (("tree-0", 0, 1001, 187, "steiner"), ("tree-1", 1, 2002, 163, "steiner"),
                                                ("alone-0", 0, 4111, 151, "independent")):
        finished(suite, name, seed, epochs, successes, kind)
    found = json.loads(json.dumps(results_json(finished_runs(suite))))
    alone, tree = found["rows"]
    assert (tree["method"], tree["task"], tree["seeds"]) == ("tree, L1, adaptive step", "061_foam_brick", 2)
    assert tree["targets"] == ["left", "right"]
    assert tree["sim_epochs"] == {"mean": 1508.5, "sd": pytest.approx(np.std([1008, 2009], ddof=1))}
    assert tree["train_iterations"] == {"mean": 6, "sd": 0} and tree["check_episodes"]["mean"] == 32
    low, high = binomtest(350, 400).proportion_ci(0.95, method="wilson")
    assert tree["success"]["left"] == {"native": 350 / 400, "ci95": pytest.approx([low, high])}
    assert (alone["method"], alone["seeds"], alone["sim_epochs"]) == ("independent, adaptive step", 1, {"mean": 4118, "sd": None})
    (ratio,) = found["ratios"]
    assert (ratio["tree"], ratio["independent"], ratio["targets"]) == (tree["method"], alone["method"], ["left", "right"])
    assert ratio["sim_epochs"] == pytest.approx(4118 / 1508.5) and ratio["train_iterations"] == pytest.approx(1.0)


def test_learners_are_not_mixed(tmp_path):
    suite = tmp_path / "suite"
    suite.mkdir()
    finished(suite, "tree-0", 0, 1000, 187)
    path = finished(suite, "alone-0", 0, 4111, 151, kind="independent")
    report = json.loads((path / "report.json").read_text())
    (path / "report.json").write_text(json.dumps(report | {"learner": "search"}))
    found = results_json(finished_runs(suite))
    assert found["ratios"] == [] and {row["method"] for row in found["rows"]} == {
        "tree, L1, adaptive step", "independent, adaptive step, search"}


def test_the_way_to_a_target_counts_the_paths_shared_with_others(tmp_path):
    path = finished(tmp_path, "tree-0", 0, 1000, 187)
    report = json.loads((path / "report.json").read_text())
    report["routes"] = {"path 1": ["hand"], "path 2": ["hand", "meta", "left"]}
    (path / "report.json").write_text(json.dumps(report))
    run = read_result(path)
    assert run.cost_to("left", "sim_epochs") == 1007
    assert run.cost_to("right", "sim_epochs") is None


def test_a_run_without_a_report_is_left_out(tmp_path):
    suite = tmp_path / "suite"
    suite.mkdir()
    Run.create(suite / "begun", {"targets": ["left"]})
    assert read_result(suite / "begun") is None
    with pytest.raises(ToolkitError, match="no finished run.*make results"):
        write_results(suite, "A suite", "make results")


def test_a_damaged_report_is_named(tmp_path):
    path = finished(tmp_path, "tree-0", 0, 1, 1)
    (path / "report.json").write_text('{"targets": ')
    with pytest.raises(ToolkitError, match=r"report\.json is not JSON: truncated or damaged"):
        read_result(path)
