"""evaluate, verify: success of a trained or exported policy."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from toolkit.cli.names import find_robot, find_task, make_lab, trained_policies
from toolkit.cli.terminal import Progress, emit
from toolkit.errors import ToolkitError

if TYPE_CHECKING:
    from toolkit.evaluation import Evaluation


def evaluate(
    run: Annotated[str, tyro.conf.Positional],
    target: str | None = None,
    native: bool = False,
    episodes: int = 100,
    seed: int = 0,
    json: bool = False,
) -> None:
    """Measure success on F(beta), or with --native on the unmodified robosuite robot, on seeds that training never saw.

    Args:
        run: a run folder, or an exported bundle.
        target: which target of the run; default: all of them.
        native: play through robosuite's own environment and step.
        episodes: per target.
        seed: shifts the evaluation's seeds.
        json: print one JSON object (a list if there are several targets).
    """
    if episodes < 1 or seed < 0:
        raise ToolkitError(f"episodes is {episodes} and seed {seed}; give at least one episode and a seed from 0 on")
    from toolkit.evaluation import evaluate_merged, evaluate_native
    from toolkit.simulation.rollout import RolloutEngine

    if (Path(run) / "manifest.json").is_file() or run.endswith(".zip"):
        result = bundle_success(Path(run), episodes, seed, quiet=json)
        emit(result.to_json(), json, sentence(result))
        return
    content, policies = trained_policies(Path(run), target)
    what = find_task(content["task"])
    lab = None if native else make_lab(content["source"], content["targets"], content["task"])
    results = []
    with Progress("evaluate", quiet=json) as progress:
        for name, policy in policies.items():
            if native:
                counter = progress.count(f"{name} native", episodes)
                results.append(evaluate_native(policy, find_robot(name), what, episodes, seed, progress=counter))
            else:
                results.append(evaluate_merged(policy, RolloutEngine(lab.merged), name, episodes, seed))
    if json:
        emit(results[0].to_json() if len(results) == 1 else [r.to_json() for r in results], True, "")
    for result in [] if json else results:
        print(sentence(result))


def verify(bundle: Annotated[Path, tyro.conf.Positional], episodes: int = 50, seed: int = 0, json: bool = False) -> None:
    """Prove a bundle: golden vectors, limits under wild observations, and success on the unmodified robot.

    Args:
        bundle: folder or .zip.
        episodes: played by the ONNX graph alone through robosuite's own step.
        seed: shifts the episodes' seeds.
        json: print one JSON object.
    """
    from toolkit.bundle import check_bundle, load_bundle

    checked = check_bundle(load_bundle(bundle))
    result = bundle_success(bundle, episodes, seed, quiet=json)
    content = checked | {"success_rate": result.success_rate, "ci95": list(result.ci95), "episodes": episodes}
    limits = "kept" if checked["limits_ok"] else "BROKEN"
    emit(content, json, f"ONNX error {checked['onnx_max_abs_error']:.1e}, limits {limits}; {sentence(result)}")
    if not (checked["golden_ok"] and checked["limits_ok"]):
        raise SystemExit(1)


def sentence(result: "Evaluation") -> str:
    """One line for people."""
    low, high = result.ci95
    counts = f"{result.successes} of {result.episodes}, {result.success_rate:.0%}"
    return f"{result.target} ({result.env}): {counts} (95 %: {low:.2f} to {high:.2f})"


def bundle_success(path: Path, episodes: int, seed: int, quiet: bool) -> "Evaluation":
    """Success of a bundle's ONNX graph alone on the unmodified robosuite robot."""
    from toolkit.bundle import load_bundle
    from toolkit.evaluation import evaluate_native

    manifest = load_bundle(path).manifest
    name = manifest["robot"]["name"]
    with Progress("evaluate", quiet) as progress:
        counter = progress.count(f"{name} native", episodes)
        return evaluate_native(path, find_robot(name), find_task(manifest["task"]["name"]), episodes, seed, progress=counter)
