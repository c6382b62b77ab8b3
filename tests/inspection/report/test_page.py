"""The report: one page that needs nothing else, opened in a real browser where there is one."""

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import pytest

from toolkit.errors import ToolkitError
from toolkit.inspection.report import page
from toolkit.runs.run import Run

VOID = {"meta", "img", "br", "hr", "link", "input"}
BROWSER = next((found for name in ("chromium", "google-chrome", "chrome") if (found := shutil.which(name))), None)


@pytest.fixture(scope="module")
def finished(small, tmp_path_factory):
    """A finished run folder with made-up figures."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    made = Run.create(folder, {"source": "adroit", "targets": ["jaco"], "task": "061_foam_brick", "note": "<b>&"})
    made.write_json("tree", small.tree("l1", "steiner").to_json())
    cost = {"path": "path 1", "stage": "evolve", "train_iterations": 3, "sim_epochs": 36, "check_episodes": 16, "diverged": 0}
    made.append_metrics({"event": "check", "success": 0.25, "held": False, **cost})
    made.append_metrics({"event": "update", "train_success": 0.5, "kl": 0.01, "mean_return": 0.2, **cost})
    made.append_metrics({"event": "check", "success": 0.75, "held": True, **cost})
    made.append_metrics({"event": "moved", "distance": 0.0, **cost})
    native = {"successes": 31, "episodes": 40, "success_rate": 0.775, "ci95": [0.63, 0.88]}
    totals = {"train_iterations": 3, "sim_epochs": 36, "check_episodes": 16, "diverged": 0}
    robot = {"grip_n": 9.0, "balance": 1.0, "height_mm": None, "opening_mm": 90.0, "closing_steps": 4.0, "clearance_mm": 20.0,
             "tracking": 0.0, "script": None}
    edge = {"from": "adroit", "to": "jaco", "robots": [{"share": 0.0, **robot}, {"share": 1.0, **robot}],
            "violations": [{"share": 0.5, "quantity": "grip_n", "value": 2.0, "allowed": [7.0, None], "cause": None}]}
    made.write_json("audit", {"verdict": "audit: 1 of 1 edges lead through worse robots", "edges": [edge]})
    made.write_json("report", {"targets": {"jaco": {"native": native, "merged": native}}, "totals": totals, "wall_s": 180.0,
                             "time": {"wall_s": 120.0}})
    return folder


@pytest.fixture(scope="module")
def written(finished, small):
    """The page of the finished run."""
    return page.write_report(finished, small.merged, small.tree("l1", "steiner").to_json())


class Strict(HTMLParser):
    """Every tag is closed in order; notes what it sees."""

    def __init__(self):
        super().__init__()
        self.open, self.links, self.text = [], [], []

    def handle_starttag(self, tag, attributes):
        self.links += [value for key, value in attributes if key in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data):
        self.text.append(data)


def test_the_page_stands_alone_and_is_sound(written):
    parser = Strict()
    parser.feed(written.read_text(encoding="utf-8"))
    parser.close()
    assert not parser.open
    assert parser.links and all(link.startswith("data:image/png;base64,") for link in parser.links), "nothing is fetched"
    text = " ".join(parser.text)
    assert "31 of 40" in text and "0.63 to 0.88" in text and "<b>&" in text, "what comes from the run is escaped"
    assert 'name="viewport"' in written.read_text(), "a phone shows it at its own width"
    pictures = {file.stem for file in written.parent.glob("*.png")}
    assert {"tree", "projection", "curves", "parameters", "audit"} <= pictures
    assert "1 of 1 edges lead through worse robots" in text
    assert "took 2.0 minutes" in text and "evaluation 3.0" in text, "the first line tells the transfer's own time"
    assert len(parser.links) == len(pictures)


@pytest.mark.skipif(BROWSER is None, reason="no browser here")
@pytest.mark.parametrize("width", [360, 1200])
def test_a_browser_shows_it(written, tmp_path, width):
    """Headless Chromium: the page has its targets, every picture loads, and nothing sticks out of a phone's screen."""
    probe = tmp_path / "probe.html"
    script = (
        "<script>addEventListener('load',()=>{const wide=[...document.querySelectorAll('body > *, img')].filter("
        "e=>e.getBoundingClientRect().right>innerWidth+1).length;const bad=[...document.images].filter(i=>!i.naturalWidth).length;"
        "document.title=`wide ${wide} bad ${bad} pictures ${document.images.length}`})</script>"
    )
    probe.write_text(written.read_text(encoding="utf-8").replace("</body>", script + "</body>"), encoding="utf-8")
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
               f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={width},900", "--virtual-time-budget=4000", "--dump-dom",
               probe.as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=180, check=True).stdout
    title = re.search(r"<title>(.*?)</title>", shown).group(1)
    assert re.fullmatch(r"wide 0 bad 0 pictures [4-9]", title), title


@pytest.mark.slow
def test_a_run_that_goes_on_gets_a_page_too(finished, small, tmp_path):
    young = tmp_path / "young"
    young.mkdir()
    for name in ("config.json", "tree.json"):
        (young / name).write_bytes((finished / name).read_bytes())
    told = page.write_report(young, small.merged, json.loads((young / "tree.json").read_bytes())).read_text(encoding="utf-8")
    assert "Not finished: 0 records so far" in told and "not measured yet" in told


def test_without_graphics_the_page_says_so(finished, small, tmp_path, monkeypatch):
    def refuse(*_):
        raise ToolkitError("no off-screen rendering here")

    monkeypatch.setattr(page, "renderer_of", refuse)
    told = page.write_report(finished, small.merged, small.tree("l1", "steiner").to_json(), tmp_path / "page").read_text(encoding="utf-8")
    assert "no off-screen rendering here" in told and "morph-1" not in told


def test_walked_edges_carry_the_last_success(finished, small):
    from toolkit.inspection.drawn_tree import Plan

    plan = Plan(small.tree("l1", "steiner").to_json())
    assert page.walked_edges(plan, Run.open(finished).read_metrics(), {}) == [("adroit", "jaco", 1.0, 0.75)]
