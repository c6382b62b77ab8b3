"""evaluate, verify: success of a trained or exported policy."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from toolkit.cli.names import bundle_roles, expert_policy, find_robot, find_task, make_lab, trained_policies
from toolkit.cli.terminal import Progress, emit
from toolkit.errors import ToolkitError

if TYPE_CHECKING:
    from toolkit.bundle.reading import Bundle
    from toolkit.evaluation.success import Evaluation


WHERE = {"native": "unmodified robot", "native-compiled": "unmodified robot, compiled step", "merged": "F(beta)"}
"""What an evaluation was played on, in the words that every page uses."""


def evaluate(
    run: Annotated[str, tyro.conf.Positional],
    target: str | None = None,
    task: str | None = None,
    native: bool = False,
    episodes: int = 100,
    seed: int = 0,
    cluster: str | None = None,
    json: bool = False,
) -> None:
    """Measure success on F(beta), or with --native on the unmodified robosuite robot, on seeds that training never saw.

    Exit status 2 if a target has no policy, or none that can be read; the others are evaluated all the same.

    Args:
        run: the run folder of a transfer or an expert, the name of a shipped expert, or an exported bundle.
        target: which target of the run; default: all of them. An expert's is its source.
        task: what is played; default: what was trained. Not for a bundle.
        native: play through robosuite's own environment and step.
        episodes: per target.
        seed: shifts the evaluation's seeds.
        cluster: Ray cluster that plays the episodes, as in transfer. Not for a bundle.
        json: print one JSON object (a list if there are several targets).
    """
    if episodes < 1 or seed < 0:
        raise ToolkitError(f"episodes is {episodes} and seed {seed}; give at least one episode and a seed from 0 on")
    from toolkit.evaluation.success import evaluate_merged, evaluate_native
    from toolkit.simulation.cluster import cluster_at
    from toolkit.simulation.rollout import RolloutEngine

    if is_bundle(run):
        if task is not None:
            raise ToolkitError(f"{run} is a bundle, whose task is written in it; leave --task {task} out")
        if cluster is not None:
            raise ToolkitError(f"{run} is a bundle, which is played on this machine alone; leave --cluster {cluster} out")
        result = bundle_success(run, episodes, seed, quiet=json)
        emit(result.to_json(), json, sentence(result))
        return
    content, policies, trouble = expert_policy(run, target) or trained_policies(Path(run), target)
    what = find_task(task or content["task"])
    lab = None if native else make_lab(content["source"], content["targets"], what.name)
    results = []
    with Progress("evaluate", quiet=json) as progress, cluster_at(cluster) as nodes:
        engine = None if lab is None else RolloutEngine(lab.merged) if nodes is None else nodes.merged(lab)
        for name, policy in policies.items():
            if engine is None:
                counter = progress.count(f"{name}, unmodified", episodes)
                results.append(evaluate_native(policy, find_robot(name), what, episodes, seed, progress=counter, cluster=nodes))
            else:
                results.append(evaluate_merged(policy, engine, name, episodes, seed))
    if json:
        emit(results[0].to_json() if len(results) == 1 else [r.to_json() for r in results], True, "")
    for result in [] if json else results:
        print(sentence(result))
    if trouble:
        raise ToolkitError("; ".join(trouble))


def is_bundle(name: str) -> bool:
    """Whether a name is a bundle's rather than a run folder's: by its manifest, its .zip, or as shipped."""
    path = Path(name)
    if path.exists():
        return (path / "manifest.json").is_file() or path.suffix == ".zip"
    from toolkit.bundle.reading import shipped_bundles

    return name in shipped_bundles() or path.suffix == ".zip"


def verify(bundle: Annotated[str, tyro.conf.Positional], episodes: int = 100, seed: int = 0, signed_by: Path | None = None,
           json: bool = False) -> None:
    """Prove a bundle: files, golden vectors, recorded episode, limits, and success on the unmodified robot against its label.

    Args:
        bundle: folder, .zip, or the name of a shipped bundle.
        episodes: played by the ONNX graph alone through robosuite's own step.
        seed: shifts the episodes' seeds.
        signed_by: OpenSSH public key; a bundle that its holder has not signed is refused.
        json: print one JSON object.
    """
    from toolkit.bundle.reading import check_bundle, load_bundle
    from toolkit.deploy.runtime import replay_golden

    loaded = load_bundle(bundle)
    if signed_by is not None:
        check_signer(loaded, signed_by)
    label = loaded.manifest.success
    checked, replayed = check_bundle(loaded), replay_golden(loaded)
    result = bundle_success(bundle, episodes, seed, quiet=json)
    replay_ok = max(replayed.values()) <= checked["tolerance"]
    success_ok = result.ci95[1] >= label.ci95[0]
    ok = checked["golden_ok"] and checked["limits_ok"] and replay_ok and success_ok
    content = checked | replayed | {
        "replay_ok": replay_ok, "target": result.target, "episodes": episodes, "successes": result.successes,
        "success_rate": result.success_rate, "ci95": list(result.ci95), "success_ok": success_ok,
        "label": {"successes": label.successes, "episodes": label.episodes, "ci95": list(label.ci95)}, "ok": ok,
    }
    said = [
        f"golden vectors: errors of {_errors(checked)}, {'ok' if checked['golden_ok'] else 'BROKEN'}",
        f"recorded episode through this machine's kinematics: {max(replayed.values()):.1e}, {'ok' if replay_ok else 'BROKEN'}",
        f"limits: {'kept' if checked['limits_ok'] else 'BROKEN'}",
        f"{sentence(result)}; label {label.successes} of {label.episodes}: {'agrees' if success_ok else 'DISAGREES'}",
    ]
    if signed_by is not None:
        said.insert(0, f"signed by the holder of {signed_by}")
    emit(content, json, "\n".join(said))
    if not ok:
        raise SystemExit(1)


def _errors(checked: dict[str, Any]) -> str:
    """Of the files that hold the policy, for people."""
    named = {"onnx": "policy.onnx", "flat": "policy_flat.onnx", "actor": "actor.safetensors"}
    found = {name: checked[f"{key}_max_abs_error"] for key, name in named.items()}
    return ", ".join(f"{name} {error:.1e}" for name, error in found.items() if error is not None)


def check_signer(bundle: "Bundle", key: Path) -> None:
    """Refuse a bundle that the holder of an OpenSSH public key has not signed."""
    from toolkit.bundle.reading import MANIFEST, SIGNATURE
    from toolkit.bundle.signing import check_signature

    check_signature(bundle.files[MANIFEST], bundle.files.get(SIGNATURE), key, f"bundle {bundle.path}")


def sentence(result: "Evaluation") -> str:
    """One line for people."""
    low, high = result.ci95
    counts = f"{result.successes} of {result.episodes}, {result.success_rate:.0%}"
    return f"{result.target} ({WHERE.get(result.env, result.env)}): {counts} (95 %: {low:.2f} to {high:.2f})"


def bundle_success(name: str, episodes: int, seed: int, quiet: bool) -> "Evaluation":
    """Success of a bundle's ONNX graph alone on the unmodified robosuite robot."""
    if episodes < 1 or seed < 0:
        raise ToolkitError(f"episodes is {episodes} and seed {seed}; give at least one episode and a seed from 0 on")
    bundle, robot, task = bundle_roles(name)
    from toolkit.evaluation.success import evaluate_native

    with Progress("evaluate", quiet) as progress:
        return evaluate_native(bundle.path, robot, task, episodes, seed, progress=progress.count(f"{robot.name}, unmodified", episodes))
