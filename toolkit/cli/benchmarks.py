"""bench: the commands that measure the toolkit itself."""

import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from toolkit.cli.deployment import DriverName
from toolkit.cli.help import helped
from toolkit.cli.names import TARGETS, TASK, Kind, Metric, find_arm, find_task, make_lab, merged_arms
from toolkit.cli.suites import SUITES
from toolkit.cli.terminal import Progress, emit, room_for, table
from toolkit.errors import ToolkitError
from toolkit.io.quoting import told

if TYPE_CHECKING:
    from toolkit.deploy.arm import ArmInfo
    from toolkit.deploy.faults import Begun, Trial
    from toolkit.simulation.cluster import Cluster
    from toolkit.transfer.pipeline import Job

bench = tyro.extras.SubcommandApp()


@bench.command(name="transfer")
@helped
def bench_transfer(
    suite: str = "real-robots",
    only: tuple[str, ...] = (),
    preset: str = "full",
    out: Path | None = None,
    play: bool = True,
    cluster: str | None = None,
    at_once: int = 4,
    json: bool = False,
) -> None:
    """Play every run of a suite that is not finished yet, then rebuild the page of results from the run folders.

    Ctrl-C leaves runs that the same command continues, also on another machine that has the folder.

    Args:
        suite: which; real-robots: the tree, independent paths and direct training to three commercial arms; hand: door, hammer and relocate
            from the free ADROIT to two, three and four fingers; ant: out of a maze, from one to six.
        only: names of the runs to play; default: all of the suite.
        preset: of every run that does not name its own, as in transfer.
        out: folder of the run folders; the page is <out>.md; default: the suite's own in docs/.
        play: --no-play only rebuilds the page.
        cluster: Ray cluster that plays the episodes, as in transfer; runs, and the paths of their trees, are then played side by side.
        at_once: runs that are played side by side on a cluster, with the same numbers; each takes some memory on this machine.
        json: print one JSON object of all finished runs: rows (cost and success per method, task and targets, over seeds) and ratios (each
            tree beside the independent paths to its targets).
    """
    if suite not in SUITES:
        raise ToolkitError(f"suite {suite!r} is unknown; there are: {', '.join(SUITES)}")
    title, usual, entries = SUITES[suite].title, SUITES[suite].folder, SUITES[suite].entries
    unknown = [name for name in only if name not in entries]
    if unknown:
        raise ToolkitError(f"suite {suite!r} has no run {unknown[0]!r}; it has: {', '.join(entries)}")
    if at_once < 1:
        raise ToolkitError(f"at_once is {at_once}; give at least 1")
    failed, out = {}, out or usual
    if play:
        failed = _play_suite({name: entries[name].job(preset) for name in only or entries}, out, cluster, at_once, quiet=json)
    from toolkit.benchmarks.paper import PAPER
    from toolkit.benchmarks.results import finished_runs, results_json, write_results

    trouble = [f"{name} did not finish: {why}" for name, why in failed.items()]
    broken: list[str] = []
    runs = finished_runs(out, broken.append)
    trouble += [f"left out of the page: {why}" for why in broken]
    if runs or not trouble:
        page = write_results(out, title, told("bench", "transfer", "--suite", suite), PAPER[suite])
        emit(results_json(runs) if json else None, json, f"{page}: the table and its pictures")
    if trouble:
        raise ToolkitError("; ".join(trouble))


def _play_suite(jobs: "dict[str, Job]", out: Path, cluster: str | None, at_once: int, quiet: bool) -> dict[str, str]:
    """Play what is not finished; returns why of each run that fails, which is no reason not to play the others."""
    from toolkit.expert.shelf import load_expert
    from toolkit.simulation.cluster import cluster_at

    for job in jobs.values():  # say what is missing before hours are spent
        load_expert(job.source.name, job.task, job.expert)
    left = {name: job for name, job in jobs.items() if not (out / name / "report.json").is_file()}
    if cluster is None or not left:
        found = {name: _play_run(job, out / name, None, quiet) for name, job in left.items()}
        return {name: why for name, why in found.items() if why is not None}
    with cluster_at(cluster) as nodes, ThreadPoolExecutor(at_once) as pool:
        running = {name: pool.submit(_play_run, job, out / name, nodes, quiet) for name, job in left.items()}
        try:
            found = {name: future.result() for name, future in running.items()}
        except BaseException:
            for future in running.values():
                future.cancel()
            if nodes is not None:
                nodes.close()  # the others stop where they are
            raise
    return {name: why for name, why in found.items() if why is not None}


def _play_run(job: "Job", folder: Path, cluster: "Cluster | None", quiet: bool) -> str | None:
    """Play a run, or go on with it; returns why it fails, None if it does not."""
    from toolkit.cli.training import record_run
    from toolkit.transfer.pipeline import Pipeline

    with Progress(folder.name, quiet, alone=cluster is None) as progress:
        try:
            resume, paths = (folder / "config.json").is_file(), 1 if cluster is None else len(job.targets)
            Pipeline(job, folder, resume, progress.transfer(job.transfer), record_run, cluster, paths).play()
        except ToolkitError as error:
            return str(error)
    return None


@bench.command(name="engine")
@helped
def bench_engine(
    robots: tuple[str, ...] | None = None,
    source: str = "adroit",
    task: str = TASK,
    episodes: int = 20,
    rounds: int = 8,
    scale: bool = True,
    page: Path | None = None,
    json: bool = False,
) -> None:
    """Measure the rollout engine against robosuite's own env.step and against bare mj_step, in turns on the same states.

    A control step is one action of the policy: 50 ms, 25 steps of physics. One thread is timed in processor time, the least of
    several rounds; figures of several threads need an idle machine. The report says how busy it was.

    Args:
        robots: systems; default: all that are registered.
        source: the robot whose expert plays, and the source of the merged robot.
        task: what they play.
        episodes: that the engine and env.step both play, noise included, to compare how they end; 0: none.
        rounds: turns of each racer.
        scale: also measure episodes per second against batch, threads and dimensions.
        page: also write the figures as Markdown into this file.
        json: print one JSON object.
    """
    from robots import ROBOTS

    if episodes < 0 or rounds < 1:
        raise ToolkitError(f"episodes is {episodes} and rounds {rounds}; give at least 0 and 1")
    room_for(page, (".md", ".markdown", ".txt"))
    systems = [find_arm(name) for name in (robots or ROBOTS)]
    from toolkit.benchmarks.engine import measure_engine, performance_page
    from toolkit.expert.shelf import load_expert

    policy, _ = load_expert(source, find_task(task))
    lab = make_lab(source, [robot.name for robot in systems if robot.name != source] or list(TARGETS), task)
    with Progress("engine", quiet=json) as progress:
        found = measure_engine(systems, merged_arms(lab.merged), policy.act, episodes, rounds, scale, progress.show)
    if json:
        emit(found, True, "")
    else:
        _show_engine(found)
    if page is not None:
        named = ["--robots", *robots] if robots else []
        _write_page(page, performance_page(found, told("bench", "engine", *named, "--episodes", episodes, "--page", page.name)))


def _write_page(page: Path, content: str) -> None:
    try:
        page.write_text(content)
    except OSError as error:
        raise ToolkitError(f"{page} cannot be written ({error.strerror}); choose another --page") from None


def _show_engine(found: dict) -> None:
    table("Engine, env.step and bare mj_step, contact-rich states",
          ["robot", "control steps/s", "of bare mj_step", "of env.step", "two threads", "contacts", "qpos off in 2 s",
           "observation off", "same endings"],
          [[r["name"], f"{r['control_steps_per_s']:.0f}", f"{r['ratio_to_bare_mj_step']:.2f}", f"{r['ratio_to_robosuite']:.1f} x",
            f"{r['ratio_of_two_threads']:.2f} x", f"{r['contacts']:.0f}", f"{r['parity_qpos']:.0e}", f"{r['observation_error']:.0e}",
            f"{r['outcomes']['same']} of {r['outcomes']['episodes']}"] for r in found["robots"]])
    parts = list(found["merged"][0]["mj_step"])
    table("Merged robot: where mj_step spends its time", ["F(beta) of", "control steps/s", "of bare mj_step", "rows", *parts],
          [[r["name"], f"{r['control_steps_per_s']:.0f}", f"{r['ratio_to_bare_mj_step']:.2f}", f"{r['rows']:.0f}",
            *(f"{r['mj_step'][part]:.0f} us" if part == "microseconds" else f"{r['mj_step'][part]:.0%}" for part in parts)]
           for r in found["merged"]])
    scale = found["scale"]
    if scale:
        rows = [[row["environments"], row["threads"], row["D"], f"{row['episodes_per_s']:.1f}"] for row in scale["episodes"]]
        table("Episodes per second, F(alpha) included", ["environments", "threads", "D", "episodes/s"], rows)
        print(f"F(alpha) takes {1e3 * scale['morph_s']:.1f} ms per episode; an environment takes "
              f"{scale['bytes_per_environment'] / 2**20:.1f} MiB, one per thread.")
    machine = found["machine"]
    print(f"{machine['cores']} cores; load {machine['load_before']:.1f} before, {machine['load_after']:.1f} after, this command included.")


@bench.command(name="cluster")
@helped
def bench_cluster(
    source: str = "adroit",
    targets: tuple[str, ...] = ("kinova3",),
    task: str = TASK,
    cluster: str | None = None,
    actors: tuple[int, ...] | None = None,
    episodes: int = 48,
    rounds: int = 3,
    paths: int = 3,
    batch: int = 24,
    runs: Path = SUITES["real-robots"].folder,
    json: bool = False,
) -> None:
    """Measure episodes on a Ray cluster against this machine's own engine: rate, bits, bytes, time to start.

    Args:
        source: the robot whose expert plays.
        targets: towards which its robots are changed.
        task: what it does.
        cluster: auto, or HOST:PORT of the head; default: two nodes on this machine, begun for the measurement and ended after it.
        actors: how many; several numbers are measured one after the other; default: 1 and this machine's processors.
        episodes: of a batch.
        rounds: of each racer, in turns; the fastest counts.
        paths: of a transfer that are played side by side, for the rates that are worked out for larger clusters.
        batch: its episodes per update, for the same.
        runs: folder of finished runs, of which those with several seeds are worked out for larger clusters as well.
        json: print one JSON object.
    """
    cores = len(os.sched_getaffinity(0))
    actors = actors or tuple(sorted({1, cores}))
    if min(*actors, episodes, rounds, paths, batch) < 1:
        raise ToolkitError(f"actors are {actors}, episodes {episodes}, rounds {rounds}, paths {paths} and batch {batch}; give at least 1")
    lab = make_lab(source, targets, task)
    from toolkit.benchmarks.cluster import local_nodes, measure_cluster
    from toolkit.expert.shelf import load_expert

    policy, _ = load_expert(source, find_task(task))
    with Progress("cluster", quiet=json) as progress, ExitStack() as stack:
        shares = (max(actors) - max(actors) // 2, max(actors) // 2)
        address = cluster or local_nodes(stack, [share for share in shares if share])
        found = measure_cluster(lab, address, policy, actors, episodes, rounds, paths, batch, runs, progress.show)
    if json:
        emit(found, True, "")
        return
    table("Episodes on the cluster and on as many threads of this machine",
          ["actors", "start", "episodes/s", "this machine", "ratio", "same bits"],
          [[row["actors"], f"{row['start_s']:.1f} s", f"{row['episodes_per_s']:.2f}", f"{row['local_episodes_per_s']:.2f}",
            f"{row['ratio_to_local']:.2f}", "yes" if row["same_bits"] else "NO"] for row in found["rows"]])
    table(f"Worked out for {paths} paths at once with {batch} episodes per update", ["cores", "busy", "episodes/s"],
          [[row["cores"], row["busy"], f"{row['episodes_per_s']:.1f}"] for row in found["projected"]])
    table("The paper's tables, five seeds side by side: hours of playing, were their episodes as long",
          ["task", "method", *(f"{row['cores']} cores" for row in found["projected"]), "updates are the limit from"],
          [[row["task"], row["method"], *(f"{hours:.2f}" for hours in row["hours"]), f"{row['cores']} cores"] for row in found["paper"]])
    if found["runs"]:
        table(f"The runs in {runs}, five seeds side by side: hours, the slowest seed's, with what is done beside playing",
              ["task", "method", "targets", *(f"{row['cores']} cores" for row in found["projected"])],
              [[row["task"], row["method"], row["targets"], *(f"{hours:.2f}" for hours in row["hours"])] for row in found["runs"]])
    print(f"An episode takes a core {found['episode_s']:.2f} s; {found['bytes_sent'] / 1024:.0f} KiB go out with it and "
          f"{found['bytes_returned'] / 1024:.0f} KiB come back. {found['cores']} cores, load {found['load']:.1f}.")


@bench.command(name="walk")
@helped
def bench_walk(
    source: str = "adroit",
    targets: tuple[str, ...] = TARGETS,
    task: str = TASK,
    kind: Kind = "steiner",
    metric: Metric = "l1",
    steps: int = 10,
    episodes: int = 16,
    expert: str | None = None,
    plot: Path | None = None,
    json: bool = False,
) -> None:
    """Walk the evolution tree with the source expert, untrained, and measure where it breaks.

    Args:
        source: the robot that the expert was trained on.
        targets: where the tree leads.
        task: what the expert does.
        kind: evolution tree: steiner, geometric-median or independent paths.
        metric: distance between robots.
        steps: parts of every edge.
        episodes: per robot.
        expert: another policy of the source, as in transfer.
        plot: draw success along every edge into this file (PNG, PDF or SVG).
        json: print one JSON object.
    """
    if steps < 1 or episodes < 1:
        raise ToolkitError(f"steps is {steps} and episodes {episodes}; give at least one of each")
    room_for(plot)
    lab = make_lab(source, targets, task)
    from toolkit.evaluation.walk import walk
    from toolkit.expert.shelf import load_expert
    from toolkit.simulation.rollout import RolloutEngine

    policy, _ = load_expert(source, lab.task, expert)
    tree = lab.tree(metric, kind)
    total = len(tree.edges) * (steps + 1)
    found = []
    with Progress("walk", quiet=json) as progress:
        for waypoint in walk(policy, RolloutEngine(lab.merged), tree, steps, episodes, lab.sight):
            found.append(waypoint)
            progress.show(f"{waypoint.start} to {waypoint.end}", f"{waypoint.successes} of {episodes}", len(found), total)
    if json:
        emit({"source": source, "task": task, "kind": kind, "metric": metric, "waypoints": [asdict(w) for w in found]}, True, "")
    else:
        table(f"{source}'s expert along the tree", ["from", "to", "share", "successes", "diverged"],
              [[w.start, w.end, f"{w.share:.2f}", f"{w.successes} of {w.episodes}", w.diverged] for w in found])
    if plot is not None:
        from toolkit.benchmarks.results import plot_walk

        plot_walk(found, plot)


@bench.command(name="tree")
@helped
def bench_tree(
    terminals: tuple[int, ...] = tuple(range(4, 21)),
    dimensions: int = 105,
    metric: tuple[Metric, ...] = ("l1", "l2"),
    seed: int = 0,
    longer: float = 0.0,
    json: bool = False,
) -> None:
    """Time the shortest tree over random points, and say how far its proof reaches.

    Args:
        terminals: how many robots, source included.
        dimensions: D of the evolution space.
        metric: distance between robots.
        seed: of the points.
        longer: also search so many times longer, and compare; 20 takes minutes.
        json: print one JSON object.
    """
    from toolkit.benchmarks.trees import time_trees
    from toolkit.evolution.tree import MAX_TERMINALS

    if not terminals or min(terminals) < 2 or max(terminals) > MAX_TERMINALS:
        raise ToolkitError(f"terminals are {', '.join(map(str, terminals)) or 'none'}; give numbers from 2 to {MAX_TERMINALS}")
    if dimensions < 1 or seed < 0 or not 0 <= longer < 1e6:
        raise ToolkitError(f"dimensions is {dimensions}, seed {seed}, longer {longer}; give at least 1, 0 and 0")
    found = []
    with Progress("trees", quiet=json) as progress:
        for timing in time_trees(terminals, dimensions, metric, seed, longer):
            found.append(timing)
            detail = f"{timing.terminals} robots in {1e3 * timing.seconds:.0f} ms"
            progress.show(timing.metric.upper(), detail, len(found), len(terminals) * len(metric))
    if json:
        emit({"dimensions": dimensions, "seed": seed, "trees": [asdict(timing) for timing in found]}, True, "")
        return
    excess = lambda t: "" if t.excess is None else f"{t.excess:.2%}"  # noqa: E731
    table(f"Shortest trees over random points, D = {dimensions}",
          ["metric", "robots", "ms", "ms of CPU", "length", "lower bound", "gap", "proven", "above the longer search"],
          [[t.metric.upper(), t.terminals, f"{1e3 * t.seconds:.1f}", f"{1e3 * t.cpu_seconds:.1f}", f"{t.length:.3f}",
            f"{t.lower_bound:.3f}", f"{t.gap:.1%}", "yes" if t.optimal else "no", excess(t)] for t in found])


@bench.command(name="metric")
@helped
def bench_metric(
    source: str = "adroit",
    targets: tuple[str, ...] = TARGETS,
    task: str = TASK,
    robots: int = 40,
    episodes: int = 3,
    expert: str | None = None,
    joints: Literal["measured", "retargeted"] = "retargeted",
    seed: int = 0,
    json: bool = False,
) -> None:
    """Weigh each evolution parameter by how much it changes a rollout, and ask whether that foretells failure better than plain L1.

    Args:
        source: the robot that the expert was trained on.
        targets: where the policy should go.
        task: what the expert does.
        robots: random robots between source and targets on which the untrained expert is judged.
        episodes: per robot.
        expert: another policy of the source, as in transfer.
        joints: how it sees the fingers of other robots, as in transfer.
        seed: of the robots.
        json: print one JSON object.
    """
    if robots < 3 or episodes < 1 or seed < 0:
        raise ToolkitError(f"robots is {robots}, episodes {episodes}, seed {seed}; give at least 3, 1 and 0")
    lab = make_lab(source, targets, task)
    from toolkit.benchmarks.metrics import compare_metrics
    from toolkit.expert.shelf import load_expert
    from toolkit.simulation.rollout import RolloutEngine

    policy, _ = load_expert(source, lab.task, expert)
    with Progress("metric", quiet=json) as progress:
        measured = lambda done, total: progress.show("weights", f"{done} of {total} parameters", done, total)  # noqa: E731
        sight = lambda alpha: lab.sight(alpha, joints == "retargeted")  # noqa: E731
        found = compare_metrics(RolloutEngine(lab.merged), policy, *lab.terminals(), sight, robots, episodes, seed, measured)
    if json:
        emit(asdict(found), True, "")
        return
    table("What foretells the untrained expert's failure",
          ["metric", "rank correlation", "better than L1 in", "tree", "independent paths", "ratio"],
          [[m.name, f"{m.correlation:.2f}", f"{m.ahead:.0%}", f"{m.length:.1f}", f"{m.independent_length:.1f}", f"{m.ratio:.2f}"]
           for m in found.metrics])
    print(f"Mean success of the untrained expert on {robots} robots: {found.success:.0%}; "
          f"weights from {min(found.weights):.2g} to {max(found.weights):.2g} of their mean.")


@bench.command(name="tick")
@helped
def bench_tick(bundle: Annotated[str, tyro.conf.Positional] = "kinova3", ticks: int = 2000, json: bool = False) -> None:
    """Time the runtime's tick on this machine, without an arm: observation, policy, safety, command, in each form of command.

    Run it on the robot PC, with what else runs there. A tick must stay well within the policy's period, 50 ms.

    Args:
        bundle: folder, .zip, or the name of a shipped bundle, whose recorded episode is replayed.
        ticks: of each form.
        json: print one JSON object.
    """
    if ticks < 100:
        raise ToolkitError(f"ticks is {ticks}; give at least 100, of which one in a hundred is the 99th percentile")
    import os

    import numpy as np

    from toolkit.bundle.reading import load_bundle
    from toolkit.deploy.arm import FORMS
    from toolkit.deploy.runtime import time_ticks

    loaded, found = load_bundle(bundle), dict[str, Any]()
    with Progress("ticks", quiet=json) as progress:
        for form in FORMS:
            progress.show(form, f"{ticks} ticks", len(found), len(FORMS))
            spent = time_ticks(loaded, form, ticks)
            whole = spent.sum(axis=1)
            names = ("observe_ms", "policy_ms", "command_ms", "p50_ms", "p99_ms", "max_ms")
            numbers = [*np.median(spent, axis=0), *np.percentile(whole, [50, 99, 100])]
            found[form] = dict(zip(names, map(float, numbers), strict=True))
    load = os.getloadavg()[0]
    if json:
        emit({"bundle": loaded.manifest.robot.name, "ticks": ticks, "load": load, "forms": found}, True, "")
        return
    table(f"A tick of {loaded.manifest.robot.name}: medians of its parts and the whole, in ms; load {load:.1f}",
          ["form", "observe", "policy", "command", "half below", "99 % below", "longest"],
          [[form, *(f"{value:.2f}" for value in row.values())] for form, row in found.items()])


@bench.command(name="fuzz")
@helped
def bench_fuzz(
    bundle: Annotated[str, tyro.conf.Positional] = "kinova3",
    files: int = 2000,
    formats: tuple[str, ...] = (),
    seed: int = 0,
    json: bool = False,
) -> None:
    """Damage files of every format that is read, and see that each is refused by a sentence or read.

    Exit status 1 if a reader raises anything but its sentence, ends its process, takes 2 GiB, or takes half a minute.

    Args:
        bundle: folder, .zip, or the name of a shipped bundle, which is damaged.
        files: of each format.
        formats: which; default: all.
        seed: of the damage.
        json: print one JSON object.
    """
    from toolkit.benchmarks.fuzz import FORMATS, fuzz
    from toolkit.bundle.reading import find_bundle

    unknown = [name for name in formats if name not in FORMATS]
    if unknown or files < 1 or seed < 0:
        raise ToolkitError(f"formats are {', '.join(formats) or 'all'}, files {files} and seed {seed}; give at least one file, a seed "
                           f"from 0 on, and formats of: {', '.join(FORMATS)}")
    found = []
    with Progress("fuzz", quiet=json) as progress:
        shown = lambda name, done: progress.show(name, f"{done} of {files} read", done, files, now=done == files)  # noqa: E731
        for tally in fuzz(formats or tuple(FORMATS), files, seed, find_bundle(bundle), shown):
            found.append(tally)
    if json:
        emit({"seed": seed, "formats": [tally.to_json() for tally in found]}, True, "")
    else:
        table("Damaged files", ["format", "files", "refused by a sentence", "read", "broke the reader", "slowest", "first"],
              [[t.format, t.files, t.refused, t.read, t.broken.total(), f"{1e3 * t.slowest:.0f} ms", t.first] for t in found])
    if any(tally.broken for tally in found):
        raise SystemExit(1)


@bench.command(name="hostile")
@helped
def bench_hostile(
    bundle: Annotated[str, tyro.conf.Positional] = "kinova3",
    ticks: int = 20_000,
    form: Literal["osc", "pose", "joint", "all"] = "all",
    seed: int = 0,
    json: bool = False,
) -> None:
    """Play wild policies in a world that lies, and hold every command against the manifest: no limit passed, every lie held in its tick.

    A million ticks of each form take about an hour of an idle core. Exit status 1 if one is not as it must be.

    Args:
        bundle: folder, .zip, or the name of a shipped bundle.
        ticks: of each form.
        form: of the commands.
        seed: of policy, noise and lies.
        json: print one JSON object.
    """
    if ticks < 1 or seed < 0:
        raise ToolkitError(f"ticks is {ticks} and seed {seed}; give at least one tick and a seed from 0 on")
    from toolkit.benchmarks.hostile import hostile_ticks
    from toolkit.bundle.reading import load_bundle
    from toolkit.deploy.arm import FORMS

    loaded, found = load_bundle(bundle), []
    with Progress("hostile", quiet=json) as progress:
        for each in FORMS if form == "all" else (form,):
            shown = lambda done, each=each: progress.show(each, f"{done} of {ticks} ticks", done, ticks)  # noqa: E731
            found.append(hostile_ticks(loaded, each, ticks, seed, shown))
    if json:
        emit({"bundle": loaded.manifest.robot.name, "seed": seed, "forms": [tally.to_json() for tally in found]}, True, "")
    else:
        table(f"{loaded.manifest.robot.name}: hostile ticks", ["form", "ticks", "episodes", "lies", "held ticks", "breaches", "first"],
              [[t.form, t.ticks, t.episodes, t.lies, t.faults.total(), t.breaches.total(), t.first] for t in found])
    if any(tally.breaches for tally in found):
        raise SystemExit(1)


def _faults_page(found: "list[Trial]", command: str) -> str:
    """What came of every fault as Markdown, a row each, a column for each form of command."""
    forms = list(dict.fromkeys(trial.form for trial in found))
    faults = list(dict.fromkeys((trial.layer, trial.fault, trial.must) for trial in found))
    cells = {(trial.layer, trial.fault, trial.form): _fault_cell(trial) for trial in found}
    lines = [
        "# Faults", "",
        f"Written by `{command}`: {sum(trial.met for trial in found)} of {len(found)} met. What must come of a fault: *stop*: the arm is "
        "held at once, and then stopped with a reason; *pass*: held, and let go on; *play*: borne; *refuse*: never moved. In a cell: as "
        "what it was noticed; ticks until the arm was held; how far the grasp frame had truly gone by then, and when it stood or went "
        "on.", "",
        "| layer | fault | must | " + " | ".join(forms) + " |", "|---|---|---|" + "---|" * len(forms),
    ]
    return "\n".join([*lines, *(f"| {layer} | {name} | {must} | " + " | ".join(cells.get((layer, name, form), "") for form in forms) + " |"
                                for layer, name, must in faults)]) + "\n"


def _fault_cell(trial: "Trial") -> str:
    """A trial in a few words."""
    ended = trial.outcome.removeprefix("stopped: ").split(" (")[0]
    if trial.ticks is None:
        told = ended if trial.layer in ("process", "line", "disk") else trial.seen or ended
    else:
        told = f"{trial.seen}; {trial.ticks} ticks, {trial.to_hold_mm:.0f} mm, {trial.to_rest_mm:.0f} mm"
        told += f"; {ended.split(':')[0]}" if trial.must in ("pass", "play") else ""
    return ("" if trial.met else "**unmet** ") + told


@bench.command(name="faults")
def bench_faults(
    bundle: Annotated[str, tyro.conf.Positional] = "kinova3",
    form: Literal["osc", "pose", "joint", "all"] = "all",
    driver: DriverName = "sim",
    only: str = "",
    page: Path | None = None,
    json: bool = False,
) -> None:
    """Inject faults between arm and runtime: lying states, old stamps, orders not obeyed, dead processes, bad clients, a full disk.

    Every fault is played in an episode of its own: through the twin's socket, or through a vendor's driver, whose package is a mock
    around a kinematic arm. The exit status is 1 if one is not met as it must be.

    Args:
        bundle: folder, .zip, or the name of a shipped bundle.
        form: of the commands; all: those that the driver takes.
        driver: sim (the twin), or ur, franka, kortex or ros2 on a mock of the vendor's package, with the bundle's own arm behind it.
        only: faults whose name or layer (state, stamp, start, order, vendor, process, line, disk) holds this text.
        page: also write the table as Markdown into this file.
        json: print one JSON object.
    """
    room_for(page, (".md", ".markdown", ".txt"))
    from toolkit.bundle.reading import load_bundle
    from toolkit.cli.deployment import start_twin
    from toolkit.deploy.arm import FORMS
    from toolkit.deploy.drivers.sim import SimDriver
    from toolkit.deploy.faults import faults_for, line_trials, trials
    from toolkit.deploy.mocks import VENDORS, mocked

    loaded, found = load_bundle(bundle), []
    takes = FORMS if driver == "sim" else VENDORS[driver].forms
    if form not in ("all", *takes):
        raise ToolkitError(f"the driver {driver} takes no {form!r} commands; it takes: {', '.join(takes)}")
    faults = tuple(fault for fault in faults_for(None if driver == "sim" else VENDORS[driver]) if only in fault.name or only == fault.layer)
    forms = takes if form == "all" else (form,)
    others = driver == "sim" and (not only or only in ("process", "line", "disk"))
    if not faults and not others:
        raise ToolkitError(f"no fault of driver {driver} is named {only!r}; give a part of its name, or state, stamp, start, order, "
                           "vendor, process, line or disk")
    with Progress("faults", quiet=json) as progress:

        def met(trial: "Trial") -> None:
            found.append(trial)
            unmet = sum(not trial.met for trial in found)
            progress.show(f"{loaded.manifest.robot.name} {trial.form}", f"{unmet} unmet, last: {trial.fault}", len(found))

        def play(arm: "Begun", info: "ArmInfo") -> None:
            for each in forms:
                for trial in trials(loaded, arm, info, each, faults):
                    met(trial)

        if driver != "sim":
            with mocked(loaded, driver) as arm:
                play(arm, arm.connect())
        elif faults:
            twin, port = start_twin(bundle, "lockstep")  # whose own time no busy machine delays
            simulated = SimDriver("127.0.0.1", port)
            try:
                play(simulated, simulated.connect())
            finally:
                simulated.close()
                twin.terminate()
                twin.wait()
        for trial in line_trials(loaded, lambda pace: start_twin(bundle, pace)) if others else ():
            met(trial)
    unmet = [trial for trial in found if not trial.met]
    if json:
        emit({"bundle": bundle, "driver": driver, "trials": [asdict(trial) for trial in found], "unmet": len(unmet)}, json, "")
    else:
        table(f"{loaded.manifest.robot.name} by the driver {driver}: a bad day",
              ["fault", "form", "must", "noticed as", "ticks", "mm to hold", "mm to rest", "came of it", ""],
              [[t.fault, t.form, t.must, t.seen[:60], "" if t.ticks is None else t.ticks, f"{t.to_hold_mm:.1f}", f"{t.to_rest_mm:.1f}",
                t.outcome[:80], "met" if t.met else "UNMET"] for t in found])
        print(f"{len(found) - len(unmet)} of {len(found)} faults met as they must be.")
    if page is not None:
        chosen = [*(["--form", form] if form != "all" else []), *(["--driver", driver] if driver != "sim" else []),
                  *(["--only", only] if only else [])]
        _write_page(page, _faults_page(found, told("bench", "faults", bundle, *chosen, "--page", page.name)))
    if unmet:
        raise SystemExit(1)
