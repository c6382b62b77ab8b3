"""What a run says of a policy that is exported: where it came from, how often it succeeds, where it holds."""

import dataclasses
import hashlib
import json
from pathlib import Path

import pytest
from scipy.stats import binomtest

from robots import ROBOTS
from tasks import TASKS
from toolkit.benchmarks.results import read_result
from toolkit.bundle.manifest import Held
from toolkit.errors import ToolkitError
from toolkit.evaluation.success import Evaluation
from toolkit.export import labels
from toolkit.export.labels import LABEL_EPISODES, holds_of, label_of, lineage_of
from toolkit.export.packing import _held

RUN = Path(__file__).parents[2] / "docs" / "results" / "plain-tree-0"


def test_ranges_go_into_a_bundle_only_from_a_test_of_its_own_policy(tmp_path):
    policy = tmp_path / "run.policy.safetensors"
    policy.write_bytes(b"a policy")
    result = {
        "policy": hashlib.sha256(b"a policy").hexdigest(), "target": "jaco", "task": "pick", "episodes": 20,
        "ranges": {"delay": {"low": 0.0, "high": 2.0, "unit": "steps", "nominal": 0.0, "meaning": "late"}},
        "alone": [{"conditions": {}}, *({"conditions": {"delay": float(n)}} for n in (1, 2, 3))],
    }
    (tmp_path / "result.json").write_text(json.dumps(result))
    held = Held("delay", "steps", "late", 0.0, 0.0, 2.0, 0.0, 3.0, 20)
    assert holds_of(tmp_path, policy, "jaco", "pick") == (held,)
    table = "\n".join(_held((held,)))
    assert "## Where it holds" in table and "| late [steps] | 0 | 0 to 2 | 0 to 3 |" in table and "20 episodes" in table
    assert _held(()) == []
    with pytest.raises(ToolkitError, match="is of target jaco, but what is exported is iiwa; give its own stress test"):
        holds_of(tmp_path, policy, "iiwa", "pick")
    policy.write_bytes(b"another policy")
    with pytest.raises(ToolkitError, match="is of policy .*; give its own stress test"):
        holds_of(tmp_path, policy, "jaco", "pick")
    policy.write_bytes(b"a policy")
    (tmp_path / "result.json").write_text(json.dumps(result | {"ranges": {"delay": {"low": 1.0}}}))
    with pytest.raises(ToolkitError, match="is no result of a stress test"):
        holds_of(tmp_path, policy, "jaco", "pick")
    with pytest.raises(ToolkitError, match="give the folder of a finished stress --out"):
        holds_of(tmp_path / "nowhere", policy, "jaco", "pick")


# -- where it came from, and how often it succeeds -----------------------------------------------------------


@pytest.mark.parametrize("target", ["jaco", "kinova3", "iiwa"])
def test_a_lineage_is_of_the_way_to_its_target(target):
    """Of a committed run: its cost is that of the paths from the source to it, not of those to the other targets."""
    found, run = lineage_of(RUN, target), read_result(RUN)
    nodes = {node["name"]: node for node in json.loads((RUN / "tree.json").read_bytes())["nodes"]}
    assert found.source == found.route[0] == "adroit" and found.route[-1] == target and set(found.route[1:-1]) == {"meta"}
    assert list(found.alpha) == nodes[target]["alpha"] and (found.kind, found.metric) == ("steiner", "l1")
    assert found.train_iterations == run.cost_to(target, "train_iterations")
    assert found.sim_epochs == run.cost_to(target, "sim_epochs") < run.report["totals"]["sim_epochs"]


def test_a_run_without_a_report_has_a_lineage_without_cost(tmp_path):
    (tmp_path / "tree.json").write_bytes((RUN / "tree.json").read_bytes())
    found = lineage_of(tmp_path, "iiwa")
    assert (found.source, found.route, found.train_iterations, found.sim_epochs) == ("adroit", ("iiwa",), 0, 0)
    with pytest.raises(ToolkitError, match=r"tree.json has no node 'sawyer'; give the run that was trained for it"):
        lineage_of(tmp_path, "sawyer")


def test_the_label_is_the_runs_own_evaluation(monkeypatch):
    monkeypatch.setattr(labels, "evaluate_native", lambda *_, **__: pytest.fail("what was evaluated was played again"))
    told = json.loads((RUN / "report.json").read_bytes())["targets"]["jaco"]["native"]
    found = label_of(RUN, ROBOTS["jaco"], TASKS["061_foam_brick"], None)
    assert dataclasses.asdict(found) == {
        **{key: told[key] for key in ("episodes", "successes", "success_rate", "seed")}, "ci95": tuple(told["ci95"]),
        "measured": "by the run that trained it, through robosuite's own step"}


def test_a_policy_that_was_not_evaluated_is_measured_at_export(tmp_path, monkeypatch):
    asked = []

    def measured(policy, robot, task, episodes, progress):
        asked.append((policy, robot.name, task.name, episodes))
        return Evaluation(robot.name, "native", episodes, 30, 0, 10**9)

    monkeypatch.setattr(labels, "evaluate_native", measured)
    found = label_of(tmp_path, ROBOTS["iiwa"], TASKS["061_foam_brick"], "the policy")
    assert asked == [("the policy", "iiwa", "061_foam_brick", LABEL_EPISODES)]
    assert (found.episodes, found.successes, found.seed) == (LABEL_EPISODES, 30, 10**9) and found.measured.startswith("at export")
    assert found.ci95 == pytest.approx(tuple(binomtest(30, LABEL_EPISODES).proportion_ci(0.95, method="wilson")))
