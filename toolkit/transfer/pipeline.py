"""A transfer from names to report: robots, space, tree, expert, training, evaluation, recording, in one run folder."""

import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from tasks.record import Record
from tasks.sight import Sight
from tasks.task import Task
from toolkit.capability.audit import Audit, run_audit, verdict
from toolkit.capability.ways import Way, gone_at, turn_in, ways_of
from toolkit.errors import ToolkitError
from toolkit.evaluation.randomised import RandomisedEngine, RandomisedRobot, evaluate_randomised
from toolkit.evaluation.success import Evaluation, evaluate_compiled, evaluate_merged, evaluate_native
from toolkit.evolution import EvolutionTree, Metric
from toolkit.evolution.bend import Bend
from toolkit.expert.shelf import POLICY_FILE, load_expert
from toolkit.io.jsonfiles import read_object
from toolkit.io.quoting import markdown
from toolkit.learning.episode import Episode
from toolkit.learning.exploration import Explored, Gain
from toolkit.learning.npg import NpgConfig
from toolkit.learning.policy import GaussianPolicy, ValueFunction
from toolkit.morphology.build import MergedRobot
from toolkit.morphology.lab import Lab, Merged, System, check_players, check_roles
from toolkit.morphology.space import EvolutionSpace
from toolkit.runs.phases import PhaseRecorder
from toolkit.runs.run import Run, read_audit, read_tree
from toolkit.simulation.cluster import Cluster
from toolkit.simulation.laws import Drivable, native_plant
from toolkit.simulation.plant import Plant
from toolkit.simulation.rollout import Engine, NativeEngine, RolloutEngine
from toolkit.transfer.branch import Branch
from toolkit.transfer.events import Arrived, Entry, Moved, Spent
from toolkit.transfer.meta_evolve import Transfer
from toolkit.transfer.settings import Method, TransferConfig

PRESETS: dict[str, dict[str, Any]] = {
    # A small budget: the whole way in minutes, reported as it is.
    "quick": {"transfer": {"learner": "search", "path": "bent", "joints": "retargeted", "exploration": 0.15, "firm": 0.9, "goal": 0.9,
                           "path_budget": 600, "check_episodes": 16, "goal_episodes": 20, "check_every": 3},
              "npg": {"step_size": 0.01}, "evaluation_episodes": 40, "targets": ("kinova3", "iiwa")},
    # Larger batches and fewer conjugate gradients than the paper's: updates that fit other episodes than their own.
    "full": {"transfer": {"learner": "search", "path": "bent", "joints": "retargeted", "exploration": 0.15, "firm": 0.9, "goal": 0.9,
                          "check_every": 2, "path_budget": 15_000},
             "npg": {"step_size": 0.02, "batch_size": 24, "cg_iterations": 3},
             "evaluation_episodes": 200},
    # Every number from the paper's table.
    "paper": {"transfer": {"step": "fixed", "path_budget": 60_000}, "npg": {}, "evaluation_episodes": 200},
}
"""Preset name -> overrides of TransferConfig and NpgConfig, episodes of the final evaluation, and targets other than the usual three."""
PAPERS = {"learner": "npg", "path": "straight", "joints": "measured"}
"""The paper's own, which go with fixed steps in any preset, unless others are asked for: the search needs adaptive ones."""
TURNS_TRIED = 80
"""Turns that are searched before a transfer for an edge that no digits' going first mends, a quarter of a second each."""
AUDITED = 5
"""Robots per edge that are measured before a transfer begins."""


@dataclass(frozen=True)
class Job:
    """What a run is asked to do.

    Attributes:
        source: the robot that the expert was trained on.
        targets: where its policy should go.
        task: what it does.
        transfer: the schedule.
        evaluation_episodes: per target and robot, after training.
        expert: name of the source's policy, as for `load_expert`; None: the one shipped for source and task.
        randomise: conditions of a laboratory under which the last hop, to the unmodified robot, trains; None: as it is.
    """

    source: System
    targets: tuple[System, ...]
    task: Task
    transfer: TransferConfig = field(default_factory=TransferConfig)
    evaluation_episodes: int = 200
    expert: str | None = None
    randomise: Mapping[str, tuple[float, float]] | None = None

    def __post_init__(self) -> None:
        check_roles(self.source, self.targets)
        check_players((self.source, *self.targets), self.task)
        if self.randomise and "object_from_grasp" not in self.task.observation:
            raise ToolkitError(f"task {self.task.name!r} has no object to be seen, and no conditions of a laboratory; leave randomise out")

    def config(self) -> dict[str, Any]:
        """As written to config.json, and compared on --resume."""
        asked = {
            "source": self.source.name, "targets": [robot.name for robot in self.targets], "task": self.task.name,
            "transfer": asdict(self.transfer), "evaluation_episodes": self.evaluation_episodes,
        }
        asked |= {} if self.expert is None else {"expert": self.expert}
        return asked | ({"randomise": {name: list(pair) for name, pair in self.randomise.items()}} if self.randomise else {})


def transfer_config(preset: str, kind: Method, metric: Metric, seed: int, **overrides: Any) -> TransferConfig:
    """The schedule of a preset; fields of TransferConfig that are given and not None override the preset's.

    Raises:
        ToolkitError: an unknown preset.
    """
    if preset not in PRESETS:
        raise ToolkitError(f"preset {preset!r} is unknown; there are: {', '.join(PRESETS)}")
    values = PRESETS[preset]["transfer"] | {"kind": kind, "metric": metric, "seed": seed}
    values |= {name: value for name, value in overrides.items() if value is not None}
    if values.get("step") == "fixed":
        values |= {name: value for name, value in PAPERS.items() if overrides.get(name) is None}
    return TransferConfig(npg=NpgConfig(**PRESETS[preset]["npg"]), **values)


SAME_ROBOT = 1e-3
"""Difference of an evolution parameter up to which a resumed run's robot is the one of before: what another processor's rounding makes."""


class Recorder(Protocol):
    """Whoever is told of a run, to show it: record by record, the summary at its end, and what the telling has cost."""

    def tell(self, record: dict[str, Any]) -> None: ...

    def summary(self, text: str) -> None: ...

    def finish(self) -> Any: ...


Begin = Callable[[Path, Merged, dict[str, Any], GaussianPolicy, Callable[[str], Drivable], list[dict[str, Any]]], Recorder]
"""Begins to record a run: its folder, the merged robot, the tree as of tree.json, the expert, an unmodified target by its name, and the
records that there are of a run that is taken up again."""


class _Guarded:
    """The recording of a run, and what it keeps to be seen: whatever becomes of them, the run goes on, and says so at its end.

    Args:
        folder: the run folder.
        begin: makes the recorder.

    Attributes:
        trouble: the first thing that went wrong, in a sentence; empty if nothing did.
    """

    def __init__(self, folder: Path, begin: Callable[[], Recorder | None]) -> None:
        self.folder, self.trouble = folder, ""
        self._recorder = self._told(begin)

    def tell(self, record: dict[str, Any]) -> None:
        """See RunRecorder."""
        if self._recorder is not None:
            self._told(lambda: self._recorder.tell(record))

    def summary(self, text: str) -> None:
        """See RunRecorder."""
        if self._recorder is not None:
            self._told(lambda: self._recorder.summary(text))

    def aside(self, act: Callable[[], Any]) -> None:
        """Do what only helps to see the run."""
        self._told(act, ends=False)

    def note(self, trouble: str) -> None:
        """Trouble that somebody else had with what only helps to see the run."""
        self.trouble = self.trouble or trouble

    def finish(self) -> Any:
        """Close the recording; what it cost, or what went wrong with it in a sentence."""
        recorder, self._recorder = self._recorder, None
        cost = None if recorder is None else self._told(recorder.finish)
        return cost if not self.trouble else f"the run is not fully recorded: {self.trouble}"

    def _told(self, act: Callable[[], Any], ends: bool = True) -> Any:
        try:
            return act()
        except (ToolkitError, OSError, RuntimeError, ValueError, MemoryError) as error:
            self.trouble = self.trouble or " ".join(str(error).split()) or type(error).__name__
            if ends:
                self._recorder = None
            return None


class Pipeline:
    """One run of a job: trains, evaluates, records; can be killed at any moment and resumed.

    Args:
        job: what to do.
        folder: the run folder.
        resume: continue the run that is there.
        watch: called with every event of the transfer, for progress on a terminal.
        record: begins the run's recording; None: there is none.
        cluster: plays its episodes, with the same numbers; None: this machine does.
        at_once: paths of the tree that are played side by side. The numbers are the same.
    """

    def __init__(
        self, job: Job, folder: Path, resume: bool = False, watch: Callable[[dict[str, Any]], None] = lambda record: None,
        record: Begin | None = None, cluster: Cluster | None = None, at_once: int = 1,
    ) -> None:
        policy, value = load_expert(job.source.name, job.task, job.expert)
        self.run = Run.open(folder, job.config()) if resume else Run.create(folder, job.config())
        self.job, self.watch, self._begin, self._at_once = job, watch, record, at_once
        self.cluster = cluster
        try:
            self._prepare(folder, resume, policy, value)
        except Exception:
            self.run.end(failed=True)
            raise

    def _prepare(self, folder: Path, resume: bool, policy: GaussianPolicy, value: ValueFunction) -> None:
        """Measure and merge the robots, and take up what an earlier sitting has left."""
        job = self.job
        self.watch({"event": "preparing", "robots": [robot.name for robot in (job.source, *job.targets)]})
        self.lab = Lab(job.source, job.targets, job.task)
        dump = folder / "divergence.npz"
        self.engine = RolloutEngine(self.lab.merged, dump=dump) if self.cluster is None else self.cluster.merged(self.lab, dump)
        self.tree = self.lab.tree(job.transfer.metric, job.transfer.tree_kind)
        if resume:
            self._check_robots(folder)
        self.untrained = self._untrained(policy)  # before the transfer's clock starts
        self.audit = self._audit()
        source, targets = self.lab.terminals()
        native = {robot.name: (lambda robot=robot: self._native(robot, dump)) for robot in job.targets}
        self.transfer = Transfer(job.transfer, source, targets, policy, value, self.engine, native, self.run, self._seen, self._saw,
                                 explored(job.task), self._bends(), self._sight)
        if resume:
            try:
                self.transfer.restore()
            except (LookupError, TypeError, ValueError, AttributeError) as error:
                raise ToolkitError(
                    f"the checkpoint in {folder} is damaged, or of another version ({error!r}); start a new run under another --run"
                ) from None
        self.run.write_json("tree", self.tree.to_json())
        stalls = folder / "stalls.json"
        self.stalls = read_object(stalls, "start the transfer again under another --run") if stalls.is_file() else {}
        records = self.run.read_metrics()
        moved = Counter(record["path"] for record in records if record["event"] == "moved")
        self.phases = PhaseRecorder(folder, job.task.miss, moved)
        self._stood = {branch.path: branch.alpha for branch in self.transfer.pending}
        begin, tree = self._begin, self.tree.to_json()
        self.recording = _Guarded(
            folder, lambda: None if begin is None else begin(folder, self.lab.merged, tree, policy.copy(), self._plant, records)
        )

    def _check_robots(self, folder: Path) -> None:
        """Refuse to go on with a run whose robots were others: its alphas mean nothing among those of now."""
        if not (folder / "tree.json").is_file():
            return
        before = {node["name"]: np.array(node["alpha"], float) for node in read_tree(folder)["nodes"]}
        for node in self.tree.nodes:
            stood = before.get(node.name, np.zeros(0))
            if len(stood) != len(node.alpha) or np.abs(stood - node.alpha).max() > SAME_ROBOT:
                raise ToolkitError(
                    f"{folder} was begun with another {node.name}: robots, or how they are measured, have changed since; start a new run "
                    f"under another --run, or go on by commit {self.run.commit()}"
                )

    def _native(self, robot: System, dump: Path) -> Engine:
        """Plays on the unmodified robot of a target: where the last hop is trained and measured.

        Raises:
            ToolkitError: under a laboratory's conditions on a cluster, which plays undisturbed robots.
        """
        if self.cluster is not None and self.job.randomise:
            raise ToolkitError("a cluster plays no conditions of a laboratory; leave cluster or randomise out")
        if self.job.randomise:
            return RandomisedEngine(robot, self.job.task, self.job.randomise, dump=dump)
        return NativeEngine(robot, self.job.task, dump=dump) if self.cluster is None else self.cluster.native(robot, self.job.task, dump)

    def play(self) -> dict[str, Any]:
        """Transfer, evaluate, write everything; returns the report."""
        with self.run.at_work():
            return self._play()

    def _play(self) -> dict[str, Any]:
        try:
            policies = self.transfer.meta_evolve(self._at_once)
            for name, policy in policies.items():
                policy.save(self.run.path / f"{name}{POLICY_FILE}")
            evaluations = {name: self._evaluate(name, policy) for name, policy in policies.items()}
            report = self._report(evaluations)
            if self.job.randomise:
                report["randomised"] = self._randomised(policies, self.job.randomise)
            self.run.write_json("report", report)
            self.recording.aside(lambda: self.run.write_summary(summary(report, self.tree)))
            self.recording.summary(summary(report, self.tree))
            return report
        finally:
            self.engine.close()
            self.recording.note(self.engine.trouble)
            cost = self.recording.finish()
            self.watch({"event": "recorded", "cost": cost, "trouble": bool(self.recording.trouble)})

    def _audit(self) -> dict[str, Any]:
        """What the robots along the tree can do, in short, before any policy is taken through them. A resumed run reads it."""
        found = read_audit(self.run.path)
        if found is not None:
            return found
        if not isinstance(self.lab.merged, MergedRobot):
            found = {"verdict": f"what robots can do in {self.job.task.name} without a policy is not measured", "edges": []}
            self.run.write_json("audit", found)
            return found
        bend = self.job.transfer.path == "bent"
        edges = run_audit(self.lab.merged, ways_of(self.tree), bend=bend, robots=AUDITED, episodes=int(bend), scripted=1, causes=False,
                          brief=True, tries=TURNS_TRIED)
        found = {"verdict": verdict(edges), "edges": [edge.to_json() for edge in edges]}
        self.run.write_json("audit", found)
        self.watch({"event": "audited", "verdict": found["verdict"]})
        return found

    def _bends(self) -> dict[frozenset[str], Bend]:
        """Targets behind each edge that is not straight -> how it turns, as the audit found it best."""
        below, space = self.tree.below(), self.lab.space
        alphas = {node.name: node.alpha for node in self.tree.nodes}
        return {below[edge["to"]]: Bend(alphas[edge["from"]], gone_at(turn, space)) for edge in self.audit["edges"]
                if isinstance(space, EvolutionSpace) and (turn := turn_in(edge)) is not None}

    def _stalled(self, branch: Branch) -> None:
        """Ask of a path whose budget is spent what changes on the robots where it stands, if that can be measured."""
        if not isinstance(self.lab.merged, MergedRobot):
            return
        ahead = self.transfer.way.evolution_tree(branch).meta_alpha if branch.next_alpha is None else branch.next_alpha
        if np.linalg.norm(ahead - branch.alpha) > 1e-9:
            audit = Audit(self.lab.merged, brief=True)
            try:
                self.stalls[branch.path] = audit.change(Way("here", "next", branch.alpha, ahead))
                self.run.write_json("stalls", self.stalls)
            finally:
                audit.close()

    # ---- what is seen on the way -------------------------------------------------------------------------------

    def _saw(self, branch: Branch, episodes: list[Episode], noise: bool, policies: list[GaussianPolicy]) -> None:
        """Remember the episodes worth seeing."""
        self.recording.aside(lambda: self.phases.record(branch.path, branch.stage, branch.targets, branch.alpha, policies, episodes, noise,
                                                  branch.updates))

    def _seen(self, entry: Entry, branch: Branch) -> None:
        """Pass an event on to the terminal and into the recording."""
        record = entry.to_json()
        self.watch(record)
        if isinstance(entry.event, Spent) and branch.stage == "evolve" and branch.path not in self.stalls:
            self._stalled(branch)
        if isinstance(entry.event, Moved | Arrived):
            start = self._stood.get(branch.path, branch.alpha)
            self.recording.aside(lambda: self.phases.end(branch.path, branch.stage, branch.targets, start, branch.alpha))
        self._stood[branch.path] = branch.alpha
        self.recording.tell(record)

    def _plant(self, name: str) -> Drivable:
        """An unmodified target robot for the recording's films."""
        plant = native_plant(next(robot for robot in self.job.targets if robot.name == name), self.job.task)
        return RandomisedRobot(plant, self.job.randomise) if self.job.randomise and isinstance(plant, Plant) else plant

    # ---- what is claimed ---------------------------------------------------------------------------------------

    def _taken_to(self, robot: System, expert: GaussianPolicy) -> GaussianPolicy:
        """The expert as a policy of a target's own observations, as the transfer takes it there."""
        return expert.through(self._sight(self.lab.space.beta(robot.name)))

    def _sight(self, alpha: np.ndarray) -> Sight:
        """How policies that are taken along see the robot ``alpha`` (D,)."""
        return self.lab.sight(alpha, retargeted=self.job.transfer.joints == "retargeted")

    def _untrained(self, expert: GaussianPolicy) -> dict[str, Any]:
        """The expert on every unmodified target before any training: whether evolution is needed at all. A resumed run reads it."""
        file = self.run.path / "untrained.json"
        if file.is_file():
            return json.loads(file.read_text(encoding="utf-8"))
        episodes, found = self.job.evaluation_episodes, {}
        for robot in self.job.targets:
            own = self._taken_to(robot, expert)
            found[robot.name] = evaluate_compiled(own, robot, self.job.task, episodes, cluster=self.cluster).to_json()
            self.watch({"event": "untrained", **found[robot.name]})
        self.run.write_json("untrained", found)
        return found

    def _evaluate(self, name: str, policy: GaussianPolicy) -> dict[str, Evaluation]:
        robot = next(robot for robot in self.job.targets if robot.name == name)
        episodes = self.job.evaluation_episodes
        self.watch({"event": "evaluating", "target": name, "episodes": episodes})
        return {
            "merged": evaluate_merged(policy, self.engine, name, episodes),
            "native": evaluate_native(policy, robot, self.job.task, episodes, cluster=self.cluster),
        }

    def _randomised(self, policies: dict[str, GaussianPolicy], conditions: Mapping[str, tuple[float, float]]) -> dict[str, Any]:
        """Target -> the expert, untrained, and its policy under the conditions that the last hop was trained under."""
        job, found = self.job, {}
        expert, _ = load_expert(job.source.name, job.task, job.expert)
        for robot in job.targets:
            played = {who: evaluate_randomised(policy, robot, job.task, conditions, job.evaluation_episodes).to_json()
                      for who, policy in (("untrained", self._taken_to(robot, expert)), ("trained", policies[robot.name]))}
            found[robot.name] = {"conditions": job.config()["randomise"], **played}
        return found

    def _report(self, evaluations: dict[str, dict[str, Evaluation]]) -> dict[str, Any]:
        costs = self.transfer.costs
        total = lambda key: sum(getattr(cost, key) for cost in costs.values())  # noqa: E731
        return {
            "untrained": self.untrained,
            "targets": {name: {env: e.to_json() for env, e in both.items()} for name, both in evaluations.items()},
            "train_iterations": {path: cost.train_iterations for path, cost in costs.items()},
            "sim_epochs": {path: cost.sim_epochs for path, cost in costs.items()},
            "check_episodes": {path: cost.check_episodes for path, cost in costs.items()},
            "diverged": {path: cost.diverged for path, cost in costs.items()},
            "routes": self.transfer.routes,
            "audit": self.audit["verdict"],
            "stalls": self.stalls,
            "totals": {key: total(key) for key in ("train_iterations", "sim_epochs", "check_episodes", "diverged")},
            "wall_s": self.transfer.sampler.seconds,
            "time": self.transfer.frontier.spent | {"outside_playing": outside_playing(self.transfer.frontier.spent)},
            "seed": self.job.transfer.seed,
            "kind": self.job.transfer.kind,
            "metric": self.job.transfer.metric,
            "step": self.job.transfer.step,
            "learner": self.job.transfer.learner,
            "enough": self.job.transfer.enough,
            "path": self.job.transfer.path,
            "joints": self.job.transfer.joints if isinstance(self.lab.merged, MergedRobot) else "measured",
            "source": self.job.source.name,
            "task": self.job.task.name,
        }


def explored(task: Task) -> Explored:
    """What a task declares for the search."""
    records: tuple[tuple[Literal["observation", "action"], Record], ...] = (("observation", task.observation), ("action", task.action))
    gains = [Gain(kind, record.slice(name), entry.gain) for kind, record in records for name, entry in record.entries.items() if entry.gain]
    return Explored(task.observation.numbers("explored"), task.action.numbers("explored"), tuple(gains))


def outside_playing(spent: dict[str, float]) -> float:
    """Share of a transfer's wall time that played no episodes: learning, checkpoints, films and the tree. 0 where paths that were played
    side by side played for longer, together, than the wall's clock ran."""
    return max(0.0, 1.0 - spent["play_s"] / max(spent["wall_s"], 1e-9))


def _rate(evaluation: dict[str, Any]) -> str:
    return f"{evaluation['successes']} of {evaluation['episodes']}"


def _needed(untrained: dict[str, Any], enough: float) -> list[str]:
    """A sentence per outcome: where the expert does untrained, and where it does not."""
    without = [name for name, found in untrained.items() if found["success_rate"] >= enough]
    needed = [name for name in untrained if name not in without]
    return [f"Training {verb} needed for {', '.join(f'{name} ({_rate(untrained[name])} untrained)' for name in names)}."
            for verb, names in (("was", needed), ("was not", without)) if names]


def summary(report: dict[str, Any], tree: EvolutionTree) -> str:
    """The report as Markdown, for people."""
    lines = [
        f"# {markdown(report['source'])} to {markdown(', '.join(report['targets']))}: {markdown(report['task'])}", "",
        "| target | direct, untrained | unmodified robot | 95 % interval | F(beta) |", "|---|---|---|---|---|",
    ]
    for name, both in report["targets"].items():
        low, high = both["native"]["ci95"]
        cells = (markdown(name), _rate(report["untrained"][name]), _rate(both["native"]), f"{low:.2f} to {high:.2f}", _rate(both["merged"]))
        lines.append(f"| {' | '.join(cells)} |")
    lines += ["", *_needed(report["untrained"], report["enough"])]
    for name, found in report.get("randomised", {}).items():
        under = ", ".join(f"{condition} {low:g} to {high:g}" for condition, (low, high) in found["conditions"].items())
        rates = f"{_rate(found['untrained'])} untrained, {_rate(found['trained'])} trained"
        lines += ["", f"{markdown(name)} under {markdown(under)}: {rates}."]
    lines += ["", "| path | training iterations | simulation epochs | checking episodes |", "|---|---|---|---|"]
    for path, route in report["routes"].items():
        name = markdown(f"{path}: {' to '.join(route)}")
        lines.append(
            f"| {name} | {report['train_iterations'][path]} | {report['sim_epochs'][path]} | {report['check_episodes'][path]} |"
        )
    totals = report["totals"]
    lines += [
        f"| total | {totals['train_iterations']} | {totals['sim_epochs']} | {totals['check_episodes']} |", "",
        f"{report['audit'].capitalize()}.", "",
        *(f"{path} spent its budget: {why}." for path, why in report["stalls"].items()), *([""] if report["stalls"] else []),
        f"Tree ({report['metric'].upper()}, {report['kind']}): length {tree.length:.1f}, independent paths "
        f"{tree.independent_length:.1f}, ratio {tree.ratio:.2f}{', proven shortest' if tree.optimal else ''}.",
        f"Wall time {report['wall_s'] / 60:.1f} min; of the transfer's {report['time']['wall_s'] / 60:.1f} min, "
        f"{report['time']['outside_playing']:.0%} went into anything but playing episodes ({report['time']['learn_s']:.0f} s into "
        f"learning). Diverged simulations: {totals['diverged']} (counted as failures)"
        f"{'; the first lies in divergence.npz, for `meta-evolve replay`' if totals['diverged'] else ''}.",
    ]
    return "\n".join(lines) + "\n"
