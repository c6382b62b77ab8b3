"""Results: tables and pictures of a suite of transfer runs, from their run folders alone.

    read_result     one run folder -> Result
    write_results   all runs of a suite -> one Markdown page and its pictures; growth where trees went to more and more of the same targets
    results_json    the same figures as JSON values

No number is typed: all come from report.json, tree.json and metrics.jsonl, but for the paper's own, which are cited.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from toolkit.benchmarks.paper import SEEDS, PaperRow
from toolkit.errors import ToolkitError
from toolkit.evaluation.success import Evaluation
from toolkit.evaluation.walk import Waypoint
from toolkit.io.jsonfiles import require
from toolkit.io.quoting import letters, markdown
from toolkit.runs.run import Run, paths_to, read_report, read_tree, transfer_records

COSTS = ("train_iterations", "sim_epochs", "check_episodes")
COMPARED = ("train_iterations", "sim_epochs")
"""Costs of which the paper gives a ratio of trees to independent paths."""
PAPERS_OWN = 0.8
"""Success at which the paper stops on hands; a run says its own, unless it is of a version before."""


@dataclass(frozen=True)
class Result:
    """One finished run.

    Attributes:
        name: of its folder.
        config, report, tree: config.json, report.json, tree.json.
        metrics: records of metrics.jsonl, oldest first.
        commit: of the toolkit that played it, "unknown" if it was not a checkout.
    """

    name: str
    config: dict[str, Any]
    report: dict[str, Any]
    tree: dict[str, Any]
    metrics: list[dict[str, Any]]
    commit: str

    @property
    def method(self) -> str:
        """What distinguishes this run from others but for its seed: tree, metric, step, path and learner."""
        report = self.report
        kind = {"steiner": "tree", "geometric-median": "one meta robot", "asking": "tree that asks"}.get(report["kind"], report["kind"])
        metric = f", {report['metric'].upper()}" if self.shares else ""
        return f"{kind}{metric}, {self._steps}"

    @property
    def shares(self) -> bool:
        """Whether targets share parts of their way: a tree, or one meta robot."""
        return self.report["kind"] not in ("independent", "direct")

    @property
    def _steps(self) -> str:
        length = f" of {self.config['transfer']['xi']:g}" if self.report["step"] == "fixed" else ""
        bent = ", optimised path" if self.report["path"] == "optimised" else ""
        learner = ", search" if self.report.get("learner", "npg") == "search" else ""
        seen = ", retargeted joints" if self.report.get("joints", "measured") == "retargeted" else ""
        return f"{self.report['step']} step{length}{bent}{learner}{seen}"

    @property
    def task(self) -> str:
        """What is done, and by whose policy if it is not the expert shipped for the task."""
        expert = self.config.get("expert")
        return self.report["task"] + (f" (expert {expert})" if expert else "")

    @property
    def terms(self) -> tuple[str, str]:
        """What a tree and independent paths must have in common to be compared: task and expert, steps. A straight path is the same in
        every metric."""
        return self.task, self._steps

    def cost_to(self, target: str, key: str) -> int | None:
        """Cost of the way to one target: of the paths from the source to it, those shared with others included.

        Args:
            target: its name.
            key: one of ``COSTS``.

        Returns:
            the count; None if the run does not go there.
        """
        paths = paths_to(self.report["routes"], target)
        return sum(self.report[key][path] for path in paths) if paths else None


def read_result(folder: Path) -> Result | None:
    """The run in a folder, None while it has no report.

    Raises:
        ToolkitError: the folder is no run, or one of its files is broken.
    """
    report = read_report(folder)
    if report is None:
        return None
    run = Run.open(folder)
    asked = {"transfer": {"xi": float, "threshold": float}}
    require(run.config, asked, str(folder / "config.json"), "start the run again under another --run")
    return Result(folder.name, run.config, report, read_tree(folder), transfer_records(run), run.commit())


def finished_runs(folder: Path, tell: Callable[[str], None] = lambda why: None) -> list[Result]:
    """All runs of a suite's folder that have finished, by name; ``tell`` is called with a sentence for each that cannot be read."""
    found = []
    for path in sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []:
        try:
            result = read_result(path)
        except ToolkitError as error:
            tell(str(error))
            continue
        found += [] if result is None else [result]
    return found


def write_results(folder: Path, title: str, command: str, paper: Sequence[PaperRow] = ()) -> Path:
    """Write `<folder>.md` and the pictures in ``folder`` from the run folders in it.

    Args:
        folder: of the suite; each run is a folder in it.
        title: heading of the page.
        command: that plays the suite and writes this page.
        paper: what the paper gives for it.

    Returns:
        the page.

    Raises:
        ToolkitError: no run in the folder has finished.
    """
    broken: list[str] = []
    runs = finished_runs(folder, broken.append)
    if not runs:
        more = f" ({broken[0]})" if broken else ""
        raise ToolkitError(f"{folder} holds no finished run{more}; play the suite with: {command}")
    plot_success(runs, folder / "success.png")
    plot_curves(runs, folder / "curves.png")
    plot_cost(runs, folder / "cost.png")
    chains = growth(runs)
    if chains:
        plot_growth(chains, folder / "growth.png")
    page = folder.with_suffix(".md")
    lines = [
        f"# {title}", "",
        f"Made by `{command}` from the run folders in [{folder.name}/]({folder.name}/); none of these numbers is typed by hand.", "",
        "## Success", "", *success_table(runs), "", f"![Success per target]({folder.name}/success.png)", "",
        "Unmodified robot: in its own environment (robosuite's, gymnasium's) and by that one's step, on seeds that training never saw. "
        "F(beta): the merged robot at the target's parameters. In brackets: 95 % interval (Wilson).", "",
        "## Cost", "", *cost_table(runs, paper), "", f"![Cost per method]({folder.name}/cost.png)", "",
        "Counted as in the paper: a training iteration is one policy update, a simulation epoch one training episode. Checking "
        "episodes only measured success; the paper does not list its own. Wall time is that of the whole transfer without the final "
        "evaluation, on the machine as loaded as it was.", "",
        "## Shared against alone", "", *sharing_table(runs), "",
        "A tree beside the sum of independent paths to the same targets, by the same expert and with the same steps, all paths found "
        "in the runs above; means over their seeds. The paper's own ratio is of means over five.", "",
        *(["## Growth", "", *growth_table(chains), "", f"![Cost against the number of targets]({folder.name}/growth.png)", "",
           "Trees to more and more of the same targets beside the sum of independent paths to them; means over their seeds.", ""]
          if chains else []),
        "## Per path", "", *path_table(runs), "",
        "## On the way", "", f"![Success measured on the way]({folder.name}/curves.png)", "",
        "Each point is one measurement of the mean action's success on the next robot of the path; a point below the line means that "
        "the step was halved, or that training began there.", "",
    ]
    try:
        page.write_text("\n".join(lines), encoding="utf-8")
    except OSError as error:
        raise ToolkitError(f"{page} cannot be written ({error.strerror}); choose another --out") from None
    return page


def results_json(runs: Sequence[Result]) -> dict[str, Any]:
    """The figures of the page as JSON values.

    Returns:
        rows: per method, task and targets: costs as mean and standard deviation over the seeds (sd None for one seed), and success on the
            unmodified robots over all seeds with its 95 % interval (Wilson).
        ratios: per tree with independent paths to the same targets on the same terms, how many times cheaper its mean is.
    """
    rows, ratios = [], []
    for (method, task, _), group in _groups(runs).items():
        first = group[0]
        targets = first.config["targets"]
        costs = {key: [run.report["totals"][key] for run in group] for key in COSTS}
        rows.append({"method": method, "task": task, "targets": targets, "seeds": len(group)}
                    | {key: _mean_sd(values) for key, values in costs.items()}
                    | {"success": {target: _pooled(group, target) for target in targets}})
        alone = {key: _alone(first, runs, key) for key in COMPARED} if first.shares else {}
        if alone and None not in alone.values():
            ratios.append({"tree": method, "independent": f"independent, {first.terms[-1]}", "task": task, "targets": targets}
                          | {key: alone[key] / np.mean(costs[key]) if any(costs[key]) else None for key in COMPARED})
    return {"rows": rows, "ratios": ratios}


def _mean_sd(values: Sequence[float]) -> dict[str, float | None]:
    return {"mean": float(np.mean(values)), "sd": float(np.std(values, ddof=1)) if len(values) > 1 else None}


def _pooled(runs: Sequence[Result], target: str) -> dict[str, Any] | None:
    """Success on the unmodified robot over all runs; None where none has been evaluated."""
    found = [run.report["targets"][target]["native"] for run in runs if target in run.report["targets"]]
    if not found:
        return None
    successes, episodes = (sum(evaluation[key] for evaluation in found) for key in ("successes", "episodes"))
    pooled = Evaluation(target, "native", episodes, successes, 0, 0)
    return {"native": pooled.success_rate, "ci95": list(pooled.ci95)}


# ---- tables ----------------------------------------------------------------------------------------------------------


def success_table(runs: Sequence[Result]) -> list[str]:
    """Markdown rows: successes of every run on each target."""
    targets = _targets(runs)
    lines = ["| run | task | " + " | ".join(f"{markdown(t)}, unmodified | {markdown(t)}, F(beta)" for t in targets) + " |",
             "|---|---|" + "---|---|" * len(targets)]
    for run in runs:
        cells = []
        for target in targets:
            both = run.report["targets"].get(target, {})
            cells += [_rate(both.get("native")), _rate(both.get("merged"))]
        lines.append(f"| {markdown(run.name)} | {markdown(run.task)} | {' | '.join(cells)} |")
    return lines


def cost_table(runs: Sequence[Result], paper: Sequence[PaperRow] = ()) -> list[str]:
    """Markdown rows: cost per method and task, mean and standard deviation over seeds, beside the paper's."""
    lines = ["| method | task | seeds | training iterations | simulation epochs | checking episodes | wall time [min] |",
             "|---|---|---|---|---|---|---|"]
    for (method, task, targets), group in _groups(runs).items():
        cells = [_spread([run.report["totals"][key] for run in group]) for key in COSTS]
        wall = _spread([run.report["time"]["wall_s"] / 60 for run in group], digits=1)
        lines.append(f"| {markdown(f'{method}, to {targets}')} | {markdown(task)} | {len(group)} | {' | '.join(cells)} | {wall} |")
    for row in paper:
        cells = [f"{mean} ± {deviation}" for mean, deviation in (row.train_iterations, row.sim_epochs)]
        lines.append(f"| paper: {row.method} | {row.task} | {SEEDS} | {' | '.join(cells)} | not given | not given |")
    return lines


def sharing_table(runs: Sequence[Result]) -> list[str]:
    """Markdown rows: each tree whose targets all have independent paths of the same task, metric and steps, and the ratio to those."""
    lines = ["| run | targets | training iterations | independent | ratio | simulation epochs | independent | ratio |",
             "|---|---|---|---|---|---|---|---|"]
    for run in runs:
        cells = []
        for key in COMPARED:
            alone = _alone(run, runs, key)
            if not run.shares or alone is None:
                break
            shared = run.report["totals"][key]
            cells += [str(shared), f"{alone:.0f}", f"{alone / shared:.2f}" if shared else "-"]
        else:
            lines.append(f"| {markdown(run.name)} | {markdown(', '.join(run.config['targets']))} | {' | '.join(cells)} |")
    return lines


def _alone(run: Result, runs: Sequence[Result], key: str) -> float | None:
    """What independent paths on the run's terms cost to all of its targets, means over their seeds; None if one was not gone."""
    alike = [r for r in runs if r.report["kind"] == "independent" and r.terms == run.terms]
    # One seed's way to one target is the same whatever other targets its run has: gone twice, it counts once.
    found = [{r.report["seed"]: cost for r in alike if (cost := r.cost_to(target, key)) is not None} for target in run.config["targets"]]
    return float(sum(np.mean(list(costs.values())) for costs in found)) if all(found) else None


@dataclass(frozen=True)
class Growth:
    """What trees of one method cost to more and more targets, each set the one before and the next target.

    Attributes:
        method, task: see Result.
        targets: in the order in which they join.
        counts: numbers of targets, ascending.
        shared, alone: simulation epochs to the first ``counts`` targets, by the tree and by independent paths; means over seeds.
    """

    method: str
    task: str
    targets: tuple[str, ...]
    counts: tuple[int, ...]
    shared: tuple[float, ...]
    alone: tuple[float, ...]


SIZES = 3
"""Fewest sets of targets in which a growth can be seen."""


def growth(runs: Sequence[Result]) -> list[Growth]:
    """Every chain of at least ``SIZES`` nested sets of targets that trees of one method have gone to, independent paths to all of which are
    known; to a single target a tree is the independent path."""
    chains = []
    sets: dict[tuple[str, str], dict[tuple[str, ...], list[Result]]] = {}
    for run in runs:
        if run.shares:
            sets.setdefault((run.method, run.task), {}).setdefault(tuple(run.config["targets"]), []).append(run)
    for (method, task), groups in sets.items():
        chain_to = {last: sorted((targets for targets in groups if targets == last[: len(targets)]), key=len) for last in groups}
        longest = max(groups, key=lambda last: len(chain_to[last]))
        nested = chain_to[longest]
        counts, shared, alone = [], [], []
        for targets in nested:
            independent = _alone(groups[targets][0], runs, "sim_epochs")
            if independent is not None:
                counts.append(len(targets))
                shared.append(float(np.mean([run.report["totals"]["sim_epochs"] for run in groups[targets]])))
                alone.append(independent)
        if len(counts) >= SIZES:
            chains.append(Growth(method, task, longest, tuple(counts), tuple(shared), tuple(alone)))
    return chains


def growth_table(chains: Sequence[Growth]) -> list[str]:
    """Markdown rows: simulation epochs to the first N targets, by a tree and by independent paths, and their ratio."""
    lines = ["| method | task | targets | simulation epochs | independent | ratio |", "|---|---|---|---|---|---|"]
    for chain in chains:
        for count, shared, alone in zip(chain.counts, chain.shared, chain.alone, strict=True):
            ratio = f"{alone / shared:.2f}" if shared else "-"
            lines.append(f"| {markdown(chain.method)} | {markdown(chain.task)} | {count}, to {markdown(chain.targets[count - 1])} "
                         f"| {shared:.0f} | {alone:.0f} | {ratio} |")
    return lines


def path_table(runs: Sequence[Result]) -> list[str]:
    """Markdown rows: cost of every path of every run."""
    lines = ["| run | path | training iterations | simulation epochs | checking episodes |", "|---|---|---|---|---|"]
    for run in runs:
        for path, route in run.report["routes"].items():
            cells = " | ".join(str(run.report[key][path]) for key in COSTS)
            lines.append(f"| {markdown(run.name)} | {markdown(path)}: {markdown(' to '.join(route))} | {cells} |")
    return lines


def _targets(runs: Iterable[Result]) -> list[str]:
    return list(dict.fromkeys(target for run in runs for target in run.config["targets"]))


def _groups(runs: Sequence[Result]) -> dict[tuple[str, str, str], list[Result]]:
    groups: dict[tuple[str, str, str], list[Result]] = {}
    for run in runs:
        groups.setdefault((run.method, run.task, ", ".join(run.config["targets"])), []).append(run)
    return groups


def _rate(evaluation: dict[str, Any] | None) -> str:
    if evaluation is None:
        return "-"
    low, high = evaluation["ci95"]
    return f"{evaluation['successes']} of {evaluation['episodes']} ({low:.2f} to {high:.2f})"


def _spread(values: Sequence[float], digits: int = 0) -> str:
    mean = f"{np.mean(values):.{digits}f}"
    return f"{mean} ± {np.std(values, ddof=1):.{digits}f}" if len(values) > 1 else mean


# ---- pictures --------------------------------------------------------------------------------------------------------

def _save(figure: Figure, file: Path) -> None:
    try:
        figure.savefig(file, dpi=110)
    except (OSError, ValueError) as error:
        raise ToolkitError(f"the plot cannot be written to {file} ({error}); name a .png, .pdf or .svg file") from None


_HATCHES = ("", "//", "..", "xx", "\\\\", "++", "oo")


@letters
def plot_success(runs: Sequence[Result], file: Path) -> None:
    """A row per run, a panel per target: success on the unmodified robot with its 95 % interval."""
    targets = _targets(runs)
    figure = Figure(figsize=(9, 0.22 * len(runs) + 1.1), layout="constrained")
    panels = figure.subplots(1, len(targets), sharey=True, squeeze=False)[0]
    for target, panel in zip(targets, panels, strict=True):
        rows = [i for i, run in enumerate(runs) if target in run.report["targets"]]
        found = [runs[i].report["targets"][target]["native"] for i in rows]
        rates = np.array([e["success_rate"] for e in found])
        bounds = np.array([e["ci95"] for e in found]).reshape(-1, 2).T
        panel.errorbar(rates, rows, xerr=np.abs(bounds - rates), fmt="o", color="black", markersize=4, capsize=2, linewidth=1)
        panel.axvline(max(run.report.get("enough", PAPERS_OWN) for run in runs), color="black", linestyle=":", linewidth=1)
        panel.set_title(target, fontsize=9)
        panel.set(xlim=(-0.05, 1.05), ylim=(len(runs) - 0.5, -0.5), yticks=range(len(runs)), yticklabels=[run.name for run in runs])
        panel.grid(axis="y", linewidth=0.3)
    figure.supxlabel("success, unmodified robot", fontsize=10)
    _save(figure, file)


@letters
def plot_cost(runs: Sequence[Result], file: Path) -> None:
    """Stacked bars: training and checking episodes of every run, one segment per path."""
    figure = Figure(figsize=(9, 0.4 * len(runs) + 1.4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for panel, key, label in ((axes[0], "sim_epochs", "simulation epochs"), (axes[1], "check_episodes", "checking episodes")):
        for i, run in enumerate(runs):
            left = 0
            for k, count in enumerate(run.report[key].values()):
                panel.barh(i, count, left=left, color=f"C{k}", edgecolor="black", linewidth=0.5, hatch=_HATCHES[k % len(_HATCHES)])
                left += count
        panel.set(xlabel=f"{label}, by path", ylim=(len(runs) - 0.4, -0.6), yticks=range(len(runs)),
                  yticklabels=[run.name for run in runs])
        panel.locator_params(axis="x", nbins=5)
    _save(figure, file)


@letters
def plot_growth(chains: Sequence[Growth], file: Path) -> None:
    """Simulation epochs against the number of targets, a panel per chain: the tree, and independent paths."""
    figure = Figure(figsize=(4.2 * len(chains), 3.0), layout="constrained")
    for panel, chain in zip(figure.subplots(1, len(chains), squeeze=False)[0], chains, strict=True):
        panel.plot(chain.counts, chain.alone, marker="s", color="#d55e00", label="independent paths")
        panel.plot(chain.counts, chain.shared, marker="o", color="#0072b2", label=chain.method)
        panel.set_title(chain.task, fontsize=9)
        panel.set(xlabel="targets", ylabel="simulation epochs", xticks=chain.counts, ylim=(0, None))
        panel.legend(fontsize=8)
    _save(figure, file)


@letters
def plot_curves(runs: Sequence[Result], file: Path) -> None:
    """Success measured on the way against episodes played on the path, a panel per run and a curve per path."""
    columns = min(3, len(runs))
    rows = -(-len(runs) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for panel in panels.flat[len(runs) :]:
        panel.axis("off")
    for run, panel in zip(runs, panels.flat, strict=False):
        for k, path in enumerate(run.report["routes"]):
            checks = [r for r in run.metrics if r["event"] == "check" and r["path"] == path]
            played = [r["sim_epochs"] + r["check_episodes"] for r in checks]
            panel.plot(played, [r["success"] for r in checks], marker="osv^D*"[k % 6], markersize=3, linewidth=0.8, label=path)
        panel.axhline(run.config["transfer"]["threshold"], color="black", linestyle=":", linewidth=0.8)
        panel.set_title(run.name, fontsize=8)
        panel.set(xlabel="episodes on the path", ylim=(-0.03, 1.03))
        panel.legend(fontsize=6, loc="lower right")
    for panel in panels[:, 0]:
        panel.set_ylabel("success")
    _save(figure, file)


@letters
def plot_walk(waypoints: Sequence[Waypoint], file: Path) -> None:
    """Success of an untrained policy along every edge of a tree, a panel per edge."""
    edges = list(dict.fromkeys((w.start, w.end) for w in waypoints))
    figure = Figure(figsize=(2.2 * len(edges), 2.2), layout="constrained")
    panels = figure.subplots(1, len(edges), squeeze=False, sharey=True)
    for (start, end), panel in zip(edges, panels.flat, strict=True):
        along = [w for w in waypoints if (w.start, w.end) == (start, end)]
        panel.plot([w.share for w in along], [w.successes / w.episodes for w in along], color="black", marker="o", markersize=3)
        panel.set_title(f"{start} to {end}", fontsize=8)
        panel.set(xlabel="share of the edge", ylim=(-0.03, 1.03))
    panels[0, 0].set_ylabel("success")
    _save(figure, file)
