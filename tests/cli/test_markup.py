"""Names are data: whatever is in them, they are shown as they are, and nothing happens.

Places: terminal tables, progress and sentences, HTML, Markdown, pictures, file names, the shell lines that we print.
"""

import json
import re
import shlex
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from command_line import NAMES

from toolkit.benchmarks.fuzz import _report_of, _run_of
from toolkit.benchmarks.results import read_result, write_results
from toolkit.cli import main
from toolkit.cli.terminal import Progress, emit, table
from toolkit.errors import ToolkitError
from toolkit.evolution import Terminal, evolution_tree, plot_tree
from toolkit.inspection.drawn_tree import Plan
from toolkit.inspection.report import figures, page
from toolkit.io.quoting import markdown, plain
from toolkit.transfer.pipeline import summary


def points(tmp_path, *names):
    file = tmp_path / "points.json"
    alphas = np.eye(len(names) + 1)
    robots = [{"name": name, "alpha": alpha.tolist()} for name, alpha in zip(("s", *names), alphas, strict=True)]
    file.write_text(json.dumps({"source": robots[0], "targets": robots[1:]}))
    return file


@pytest.mark.parametrize("name", NAMES)
def test_every_table_shows_a_name_as_it_is(tmp_path, capsys, name):
    main(["tree", "--points", str(points(tmp_path, name, "other"))])
    out = capsys.readouterr().out
    assert plain(name) in out and "\x1b" not in out and "\u202e" not in out
    table(name, [name], [[name], [3]])
    assert capsys.readouterr().out.count(plain(name)) == 3


def test_two_robots_never_print_under_one_name(tmp_path, capsys):
    main(["tree", "--points", str(points(tmp_path, "panda[left]", "panda[/right]"))])
    out = capsys.readouterr().out
    assert "panda[left]" in out and "panda[/right]" in out


@pytest.mark.parametrize("name", NAMES)
def test_progress_and_sentences(capsys, name):
    with Progress(name, quiet=False) as progress:
        progress.bar.disable = False
        progress.show(name, name, 1, 2, now=True)
        assert plain(name) in "".join(str(column(progress.bar.tasks[0])) for column in progress.bar.columns[:3:2])
    assert f"{plain(name)}: {plain(name)}" in capsys.readouterr().err
    emit(None, False, f"{name}!")
    assert "\x1b" not in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["evaluate", f"nosuch {name}"])
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and "\x1b" not in said


class Tags(HTMLParser):
    """The tags of a page that are not ours, and all its text."""

    OURS = {"meta", "title", "style", "h1", "h2", "h3", "p", "figure", "figcaption", "img", "div", "table", "thead", "tbody", "tr", "th",
            "td", "pre", "html", "head", "body"}

    def __init__(self):
        super().__init__()
        self.foreign, self.text = [], ""

    def handle_starttag(self, tag, attributes):
        if tag not in self.OURS and (tag, dict(attributes).get("class")) != ("span", "bar"):
            self.foreign.append((tag, attributes))
        self.foreign += [pair for pair in attributes if pair[0].startswith("on")]

    def handle_data(self, data):
        self.text += data


@pytest.mark.parametrize("name", NAMES)
def test_the_report_page_shows_names_and_nothing_else(tmp_path, name):
    run = _run_of(tmp_path)
    config = {"source": name, "targets": [name, "b"], "task": name}
    run.config = config
    report = _report_of()
    report["targets"] = {name: report["targets"]["a"]}
    records = run.read_metrics()
    events = {"moved": name}
    records = [record | {"path": name, "event": events.get(record["event"], record["event"]), "target": name} for record in records]
    tree = {"metric": "l1", "kind": "steiner", "nodes": [{"name": "s", "kind": "source", "alpha": [0.0]},
            {"name": name, "kind": "target", "alpha": [1.0]}], "edges": [{"from": "s", "to": name, "length": 1.0}]}
    pictures = dict.fromkeys(("tree", "projection", "curves", "parameters"), b"")
    for told_of in (report, None):
        tags = Tags()
        tags.feed(page._page(run, Plan(tree), records, {}, told_of, pictures, [name]))
        assert tags.foreign == [], tags.foreign
        assert name in tags.text or re.sub(r"\s", " ", name) in re.sub(r"\s", " ", tags.text)


def cells(line):
    """Cells of a row of a Markdown table."""
    return re.split(r"(?<!\\)\|", line)[1:-1]


@pytest.mark.parametrize("name", NAMES)
def test_markdown_has_as_many_columns_as_it_had(tmp_path, name):
    assert "\n" not in markdown(name) and re.sub(r"\\(\W|_)", r"\1", markdown(name)) == plain(name)
    report = _report_of()
    report |= {"source": name, "task": name, "targets": {name: report["targets"]["a"]}, "routes": {"path 1": ["s", name]}}
    report |= {"untrained": {name: report["targets"][name]["native"]}, "audit": "audit: even", "stalls": {}, "enough": 0.8}
    tree = evolution_tree(Terminal("s", np.zeros(2)), [Terminal("a", np.ones(2))], "l1", "steiner")
    rows = [line for line in summary(report, tree).splitlines() if line.startswith("|")]
    assert [len(cells(row)) for row in rows[:3]] == [5, 5, 5] and {len(cells(row)) for row in rows[3:]} == {4}
    assert summary(report, tree).splitlines()[0].startswith("# ")


def test_the_page_of_results_survives_odd_runs(tmp_path):
    for number, name in enumerate(NAMES[:12]):
        _run_of(tmp_path / str(number)).path.rename(tmp_path / f"r{number}")
        run = tmp_path / f"r{number}"
        config = json.loads((run / "config.json").read_text())
        (run / "config.json").write_text(json.dumps(config | {"expert": name, "targets": ["a"]}))
        (tmp_path / str(number)).rmdir()
    folder = tmp_path / "suite"
    folder.mkdir()
    for run in tmp_path.glob("r*"):
        run.rename(folder / run.name)
    text = write_results(folder, "A suite", "make it").read_text()
    rows = [line for line in text.splitlines() if line.startswith("| r")]
    assert rows and all(len(cells(row)) in (4, 5, 8) for row in rows)
    assert read_result(folder / "r0").task.endswith(f"(expert {NAMES[0]})")


@pytest.mark.parametrize("name", NAMES)
def test_pictures_take_a_dollar_for_a_dollar(tmp_path, name):
    tree = evolution_tree(Terminal("s", np.zeros(2)), [Terminal(name, np.ones(2)), Terminal("b", np.array([1.0, 0.5]))], "l1", "steiner")
    plot_tree(tree, tmp_path / "tree.png")
    assert (tmp_path / "tree.png").stat().st_size > 1000
    nodes = [{"name": n, "kind": k, "alpha": a} for n, k, a in (("s", "source", [0.0, 0.0]), (name, "target", [1.0, 0.5]))]
    plan = Plan({"nodes": nodes, "edges": [{"from": "s", "to": name, "length": 1.5}]})
    assert figures.png(figures.tree_figure(plan, [("s", name, 0.5, 0.5)])).startswith(b"\x89PNG")
    assert figures.png(figures.projection_figure(plan, [])).startswith(b"\x89PNG")
    record = {"event": "check", "path": name, "stage": "evolve", "success": 0.5, "sim_epochs": 3}
    assert figures.png(figures.curves_figure([record, record])).startswith(b"\x89PNG")
    assert figures.png(figures.strip_figure(name, [np.zeros((4, 4, 3))], [0.0])).startswith(b"\x89PNG")


# -- shell lines and file names ------------------------------------------------------------------------------


def test_the_commands_print_quoted_lines(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    out = Path("my hands; echo")
    main(["recordings", "make", str(out), "--objects", "061_foam_brick", "--each", "1", "--frames", "12"])
    said = capsys.readouterr().out
    assert shlex.split(said.rsplit("look at them with: ", 1)[1])[-1] == str(out)
    with pytest.raises(SystemExit):
        main(["verify", "no such bundle"])
    assert shlex.split(capsys.readouterr().err.rsplit("write one: ", 1)[1])[-1] == "no such bundle"


def test_no_line_for_people_is_pasted_together():
    """Every command that a message recommends with a value in it goes through the quoting."""
    root = Path(page.__file__).parents[2]
    found = [f"{file.name}: {line.strip()}" for file in root.rglob("*.py") for line in file.read_text().splitlines()
             if re.search(r"meta-evolve [a-z].*\{(?!told)", line) and "robots --check {robot.name}" not in line
             and "--targets {robot.name}" not in line]
    assert not found, found


def test_a_target_is_no_path(tmp_path, capsys):
    run = _run_of(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(["view", str(run.path), "--compare", "../../elsewhere", "a", "--out", str(tmp_path / "o.rrd")])
    assert stop.value.code == 2 and "is not in" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.rrd")) and not (tmp_path.parent / "elsewhere.rrd").exists()
    config = json.loads((run.path / "config.json").read_text())
    (run.path / "config.json").write_text(json.dumps(config | {"targets": ["../x"]}))
    from toolkit.cli.names import transfer_config

    with pytest.raises(ToolkitError, match="which are no names of robots"):
        transfer_config(run.path)
