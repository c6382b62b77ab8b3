"""The command line: the only place where names become robots and tasks, and the only one that prints.

Heavy imports wait until a command needs them, so that --help answers at once.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from toolkit.errors import ToolkitError
from toolkit.quiet import silence_robosuite

if TYPE_CHECKING:
    from robots.robot import Robot
    from tasks.pick import PickTask
    from toolkit.evaluation import Evaluation
    from toolkit.learning.policy import GaussianPolicy
    from toolkit.pipeline import Lab

Kind = Literal["steiner", "geometric-median", "independent"]
Metric = Literal["l1", "l2"]
TARGETS = ("jaco", "kinova3", "iiwa")
TASK = "061_foam_brick"

app = tyro.extras.SubcommandApp()


# ---- looking names up ------------------------------------------------------------------------------------------------


def _robot(name: str) -> "Robot":
    from robots import ROBOTS

    if name not in ROBOTS:
        raise ToolkitError(f"robot {name!r} is unknown; there are: {', '.join(ROBOTS)}")
    return ROBOTS[name]


def _task(name: str) -> "PickTask":
    from tasks import TASKS

    if name not in TASKS:
        raise ToolkitError(f"task {name!r} is unknown; there are: {', '.join(TASKS)}")
    return TASKS[name]


def _lab(source: str, targets: Sequence[str], task: str) -> "Lab":
    systems = [_robot(name) for name in (source, *targets)]
    from toolkit.pipeline import Lab

    return Lab(systems[0], systems[1:], _task(task))


def _emit(content: Any, as_json: bool, text: str) -> None:
    print(json.dumps(content) if as_json else text)


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for column in columns:
        table.add_column(column)
    for row in rows:
        table.add_row(*(str(value) for value in row))
    Console().print(table)


# ---- commands --------------------------------------------------------------------------------------------------------


@app.command
def robots(json: bool = False) -> None:
    """List the systems that can be source or target.

    Args:
        json: print one JSON object instead of a table.
    """
    _robot("adroit")
    from robots import ROBOTS
    from tasks import TASKS

    rows = [
        {"name": r.name, "role": "source" if r.source_of_policy else "target", "arm": r.arm,
         "gripper": r.gripper.robosuite_type, "rate": r.gripper.rate, "preshape": r.gripper.preshape}
        for r in ROBOTS.values()
    ]  # fmt: skip
    if json:
        _emit({"robots": rows, "tasks": list(TASKS)}, True, "")
    else:
        _table("Systems", list(rows[0]), [list(row.values()) for row in rows])
        print(f"Tasks: {', '.join(TASKS)}")


@app.command
def match(
    source: str = "adroit", targets: tuple[str, ...] = TARGETS, theta: bool = False, plot: Path | None = None, json: bool = False
) -> None:
    """Merge robots into one kinematic tree and measure what the merge keeps of each.

    Args:
        source: the robot that the expert was trained on.
        targets: where the policy should go.
        theta: list every parameter of the evolution space.
        plot: draw the merged tree into this file (PNG, PDF or SVG).
        json: print one JSON object.
    """
    lab = _lab(source, targets, TASK)
    from toolkit.morphology.parity import parity, plot_merged_tree

    figures = [parity(lab.merged, robot) for robot in (lab.source, *lab.targets)]
    if plot is not None:
        plot_merged_tree(lab.space.matching, plot)
    content = {"D": lab.space.size, "source": source, "parameters": len(lab.space.parameters), "robots": figures}
    if json:
        _emit(content | ({"theta": lab.space.describe()} if theta else {}), True, "")
        return
    print(f"Evolution space: D = {lab.space.size} dimensions move {len(lab.space.parameters)} parameters.")
    _table("Merged robot against the robosuite robot", list(figures[0]), [[_short(v) for v in f.values()] for f in figures])
    slots = lab.space.matching.slots
    rows = [
        [slot.name, slots[slot.parent].name if slot.parent >= 0 else "world",
         *("yes" if s.present(i) else "-" for s in lab.space.matching.systems)]
        for i, slot in enumerate(slots)
    ]  # fmt: skip
    _table("Matched joints", ["joint", "parent", *lab.space.matching.names], rows)
    if theta:
        _table("theta", ["parameter", "unit", "dimension", *lab.space.matching.names],
               [[p["name"], p["unit"], p["dimension"], *(_short(v) for v in p["values"].values())]
                for p in lab.space.describe()])  # fmt: skip


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


@app.command
def tree(
    source: str = "adroit",
    targets: tuple[str, ...] = TARGETS,
    points: Path | None = None,
    metric: Metric = "l1",
    kind: Kind = "steiner",
    plot: Path | None = None,
    json: bool = False,
) -> None:
    """Find the evolution tree: the shortest way from the source to all targets, with its meta robots.

    Args:
        source: the robot that the expert was trained on.
        targets: where the policy should go.
        points: read source and targets from a JSON file instead: {"source": {"name", "alpha"}, "targets": [...]}.
        metric: distance between robots.
        kind: steiner (shortest tree), geometric-median (one meta robot) or independent (one path per target).
        plot: draw the tree into this file (PNG, PDF or SVG).
        json: print one JSON object.
    """
    from toolkit.evolution import evolution_tree, load_points, plot_tree

    if points is not None:
        start, goals = load_points(points)
        found = evolution_tree(start, goals, metric, kind)
    else:
        found = _lab(source, targets, TASK).tree(metric, kind)
    if plot is not None:
        plot_tree(found, plot)
    if json:
        _emit(found.to_json(), True, "")
        return
    names = [node.name for node in found.nodes]
    _table(f"{kind} tree, {metric.upper()}", ["from", "to", "length"],
           [[names[e.start], names[e.end], f"{e.length:.2f}"] for e in found.edges])  # fmt: skip
    proof = "proven shortest" if found.optimal else f"no tree is shorter than {found.lower_bound:.2f}"
    print(f"Length {found.length:.2f} ({proof}); independent paths {found.independent_length:.2f}; "
          f"ratio {found.ratio:.2f}, the saving that the tree promises.")  # fmt: skip


@app.command
def expert(
    source: str = "adroit",
    task: str = TASK,
    out: Path | None = None,
    updates: int = 6,
    demonstrations: int = 160,
    seed: int = 0,
    episodes: int = 200,
    json: bool = False,
) -> None:
    """Train the source expert: scripted demonstrations, behaviour cloning, natural policy gradient.

    Args:
        source: the robot to train on.
        task: what it does.
        out: folder for the policy; default: the package's own experts.
        updates: natural-gradient updates after cloning.
        demonstrations: scripted episodes.
        seed: of everything random.
        episodes: of the final evaluation on the source robot itself, on unseen seeds.
        json: print one JSON object at the end.
    """
    robot = _robot(source)
    from toolkit.evaluation import evaluate_native
    from toolkit.expert import SHIPPED, ExpertConfig, save_expert, train_expert
    from toolkit.simulation.rollout import RolloutEngine

    lab = _lab(source, [name for name in TARGETS if name != source], task)
    engine = RolloutEngine(lab.merged)
    config = ExpertConfig(demonstrations=demonstrations, updates=updates, seed=seed)
    with _Progress("expert", quiet=json) as progress:
        policy, value, card = train_expert(engine, source, config, progress.expert(config))
        result = evaluate_native(policy, robot, lab.task, episodes, progress=progress.count(f"{source} native", episodes))
    command = f"meta-evolve expert --source {source} --task {task} --updates {updates} --demonstrations {demonstrations} --seed {seed}"
    card |= {"command": command, "evaluation": result.to_json()}
    save_expert(policy, value, out or SHIPPED, f"{source}-{task}", card)
    low, high = result.ci95
    _emit(card, json, f"{source}, {task}: {result.successes} of {episodes} on the source robot ({low:.2f} to {high:.2f}); "
                      f"saved in {out or SHIPPED}")  # fmt: skip


@app.command
def transfer(
    source: str = "adroit",
    targets: tuple[str, ...] = TARGETS,
    task: str = TASK,
    kind: Kind = "steiner",
    metric: Metric = "l1",
    step: Literal["adaptive", "fixed"] | None = None,
    seed: int = 0,
    preset: str = "quick",
    run: Path | None = None,
    resume: bool = False,
    json: bool = False,
) -> None:
    """Transfer the source expert to every target along the evolution tree, then evaluate on the unmodified robots.

    Writes logs/<run>/: config, tree, metrics, checkpoints, recording.rrd, policies, report. Ctrl-C leaves a run that
    --resume continues to the same result.

    Args:
        source: the robot that the expert was trained on.
        targets: where the policy should go.
        task: what it does; "<object>-wide" starts within 5 cm and 30 degrees instead of 1 cm.
        kind: evolution tree: steiner, geometric-median or independent paths.
        metric: distance between robots.
        step: adaptive (farthest robot on which the policy holds) or fixed (length xi, as in the paper).
        seed: of everything random.
        preset: quick (minutes), full, or paper (every number from the paper's table).
        run: run folder; default: logs/<source>-<task>-<kind>-<metric>-<preset>-<seed>.
        resume: continue the run in that folder.
        json: print the report as one JSON object at the end.
    """
    robot, goals, what = _robot(source), tuple(_robot(name) for name in targets), _task(task)
    from toolkit.pipeline import PRESETS, Job, Pipeline, summary, transfer_config

    config = transfer_config(preset, kind, metric, seed, step)
    folder = run or Path("logs") / f"{source}-{task}-{kind}-{metric}-{preset}-{seed}"
    job = Job(robot, goals, what, config, PRESETS[preset]["evaluation_episodes"])
    with _Progress("transfer", quiet=json) as progress:
        pipeline = Pipeline(job, folder, resume, progress.transfer(config))
        report = pipeline.play()
    _emit(report, json, summary(report, pipeline.tree) + f"\nRun folder: {folder}; look at it with: meta-evolve view {folder}")


@app.command
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
        result = _bundle_success(Path(run), episodes, seed, quiet=json)
        _emit(result.to_json(), json, _sentence(result))
        return
    content, policies = _trained(Path(run), target)
    what = _task(content["task"])
    lab = None if native else _lab(content["source"], content["targets"], content["task"])
    results = []
    with _Progress("evaluate", quiet=json) as progress:
        for name, policy in policies.items():
            if native:
                counter = progress.count(f"{name} native", episodes)
                results.append(evaluate_native(policy, _robot(name), what, episodes, seed, progress=counter))
            else:
                results.append(evaluate_merged(policy, RolloutEngine(lab.merged), name, episodes, seed))
    if json:
        _emit(results[0].to_json() if len(results) == 1 else [r.to_json() for r in results], True, "")
    for result in [] if json else results:
        print(_sentence(result))


def _sentence(result: "Evaluation") -> str:
    low, high = result.ci95
    counts = f"{result.successes} of {result.episodes}, {result.success_rate:.0%}"
    return f"{result.target} ({result.env}): {counts} (95 %: {low:.2f} to {high:.2f})"


def _bundle_success(path: Path, episodes: int, seed: int, quiet: bool) -> "Evaluation":
    """Success of a bundle's ONNX graph alone on the unmodified robosuite robot."""
    from toolkit.bundle import load_bundle
    from toolkit.evaluation import evaluate_native

    manifest = load_bundle(path).manifest
    name = manifest["robot"]["name"]
    with _Progress("evaluate", quiet) as progress:
        counter = progress.count(f"{name} native", episodes)
        return evaluate_native(path, _robot(name), _task(manifest["task"]["name"]), episodes, seed, progress=counter)


@app.command
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
    result = _bundle_success(bundle, episodes, seed, quiet=json)
    content = checked | {"success_rate": result.success_rate, "ci95": list(result.ci95), "episodes": episodes}
    limits = "kept" if checked["limits_ok"] else "BROKEN"
    _emit(content, json, f"ONNX error {checked['onnx_max_abs_error']:.1e}, limits {limits}; {_sentence(result)}")
    if not (checked["golden_ok"] and checked["limits_ok"]):
        raise SystemExit(1)


def _trained(folder: Path, target: str | None) -> tuple[dict, dict[str, "GaussianPolicy"]]:
    """Config of a run folder or bundle, and its policies by target."""
    from tasks.pick import ACTION, OBSERVATION
    from toolkit.expert import entry_names
    from toolkit.learning.policy import GaussianPolicy
    from toolkit.runs import Run

    content = Run.open(folder).config
    missing = [key for key in ("source", "targets", "task") if key not in content]
    if missing:
        raise ToolkitError(f"{folder / 'config.json'} has no {missing[0]!r}, so it is no transfer's run folder")
    found = {}
    for name in content["targets"] if target is None else [target]:
        if name not in content["targets"]:
            raise ToolkitError(f"target {name!r} is not in {folder}; it has: {', '.join(content['targets'])}")
        file = folder / f"{name}.policy.safetensors"
        if not file.is_file():
            raise ToolkitError(f"{folder} has no policy for {name!r} yet; finish it with: meta-evolve transfer --run {folder} --resume")
        found[name] = GaussianPolicy.load(file, entry_names(OBSERVATION), entry_names(ACTION))
    return content, found


@app.command
def view(path: Annotated[Path, tyro.conf.Positional]) -> None:
    """Open a run's recording in the Rerun viewer.

    Args:
        path: a run folder or an .rrd file.
    """
    from toolkit.recording import show

    print(show(path))


@app.command
def export(run: Annotated[Path, tyro.conf.Positional], target: str, out: Path, json: bool = False) -> None:
    """Write a target's policy as an ONNX bundle: named observations in, robosuite's own action out.

    Args:
        run: a run folder.
        target: which target.
        out: folder of the bundle; made if needed.
        json: print the manifest.
    """
    content, policies = _trained(run, target)
    from toolkit.bundle import write_bundle

    manifest = write_bundle(policies[target], _robot(target), _task(content["task"]), content, out)
    _emit(manifest, json, f"{out}: policy.onnx, manifest.json; ONNX against NumPy {manifest['onnx_max_abs_error']:.1e}")


@app.command
def doctor(json: bool = False) -> None:
    """Check versions, models, rendering and Rerun, and say what to mend.

    Args:
        json: print one JSON object.
    """
    from toolkit.doctor import checks

    found = checks()
    if json:
        _emit({"checks": [c._asdict() for c in found]}, True, "")
    else:
        marks = {True: "ok", False: "BROKEN", None: "warning"}
        _table("Doctor", ["check", "", "found", "mend"], [[c.name, marks[c.ok], c.detail, "" if c.ok else c.mend] for c in found])
    if any(c.ok is False for c in found):
        raise SystemExit(1)


# ---- progress --------------------------------------------------------------------------------------------------------


class _Progress:
    """A live line on the terminal with rate and time left; a plain line now and then where there is no terminal."""

    def __init__(self, title: str, quiet: bool) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        self.console = Console(stderr=True)
        self.live = self.console.is_terminal and not quiet
        self.quiet = quiet
        self._last = 0.0
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[detail]}"), TimeElapsedColumn(),
                   TextColumn("left"), TimeRemainingColumn())  # fmt: skip
        self.bar = Progress(*columns, console=self.console, disable=not self.live)
        self._task = self.bar.add_task(title, total=None, detail="")

    def __enter__(self) -> "_Progress":
        self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()

    def show(self, title: str, detail: str, done: float | None = None, total: float | None = None, now: bool = False) -> None:
        """Update the line; without a terminal print at most every ten seconds, or ``now``."""
        import time

        self.bar.update(self._task, description=title, detail=detail, completed=done or 0, total=total)
        if not self.live and not self.quiet and (now or time.monotonic() - self._last > 10.0):
            self._last = time.monotonic()
            print(f"{title}: {detail}", file=sys.stderr, flush=True)

    def count(self, title: str, total: int) -> Any:
        """A callback (done, successes) for evaluations."""
        return lambda done, successes: self.show(title, f"{successes} of {done} succeed", done, total, now=done == total)

    def expert(self, config: Any) -> Any:
        """A callback for train_expert."""

        def seen(record: dict[str, Any]) -> None:
            if record["event"] == "demonstrations":
                self.show("demonstrations", f"{record['kept']} of {record['played']} kept", now=True)
            elif record["event"] == "cloning":
                self.show("cloning", f"loss {record['loss']:.4f}", record["epoch"], config.cloning.epochs)
            else:
                self.show("updates", f"success {record['success']:.0%}", record["update"] + 1, config.updates)

        return seen

    def transfer(self, config: Any) -> Any:
        """A callback for Transfer: path, distance to the meta robot, success, episodes per second, budget left."""
        state = {"distance": float("nan"), "success": float("nan"), "rate": float("nan")}

        def seen(record: dict[str, Any]) -> None:
            if record["event"] == "evaluating":
                detail = f"{record['episodes']} episodes on F(beta) and on the native robot"
                self.show(f"evaluating {record['target']}", detail, now=True)
                return
            state["distance"] = record.get("distance", state["distance"])
            state["success"] = record.get("success", record.get("train_success", state["success"]))
            state["rate"] = record.get("episodes_per_s", state["rate"])
            detail = (f"{record['event']}, distance {state['distance']:.2f}, success {state['success']:.0%}, "
                      f"{record['sim_epochs']} training episodes, {state['rate']:.1f}/s")  # fmt: skip
            self.show(f"{record['path']} {record['stage']}", detail, record["sim_epochs"], config.path_budget,
                      now=record["event"] in ("moved", "split", "arrived", "budget"))  # fmt: skip

        return seen


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; exit status 0 done, 2 bad input, 1 a failure of the tool, 130 on Ctrl-C."""
    silence_robosuite()
    try:
        app.cli(prog="meta-evolve", description="Transfer a dexterous hand's policy to commercial arms by robot evolution.",
                args=arguments)  # fmt: skip
    except ToolkitError as error:
        print(f"meta-evolve: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except BrokenPipeError:
        raise SystemExit(0) from None
    except KeyboardInterrupt:
        print("meta-evolve: stopped; a run continues with --resume", file=sys.stderr)
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
