"""Layers: who may import whom, and what no file may do, read from the syntax trees."""

import ast
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TOOLKIT = sorted((ROOT / "toolkit").rglob("*.py"))
DOOR = ROOT / "meta_evolve.py"
LEAVES = sorted(path for folder in ("robots", "grippers", "tasks") for path in (ROOT / folder).rglob("*.py"))
CLI = ROOT / "toolkit" / "cli"
RUNS_CODE = {"eval", "exec", "compile", "__import__", "yaml.load", "torch.load", "yaml.unsafe_load", "os.system"}
MAY_IMPORT_RERUN = ("toolkit/inspection/recording/", "toolkit/doctor.py")


def label(path):
    return path.relative_to(ROOT).as_posix()


every_file = pytest.mark.parametrize("path", [*TOOLKIT, *LEAVES, DOOR], ids=label)


@cache
def tree(path):
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def imports(path):
    """(module, name or None, line) of every import, at whatever depth, relative ones resolved."""
    package = list(path.relative_to(ROOT).with_suffix("").parts[:-1])
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((module, alias.name, node.lineno) for alias in node.names)


def calls(path):
    """(dotted name, line, node) of every call."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node.lineno, node


def test_there_is_something_to_look_at():
    assert len(TOOLKIT) > 15 and len(LEAVES) > 8


@pytest.mark.parametrize("path", LEAVES, ids=label)
def test_leaves_never_import_the_toolkit(path):
    found = [line for module, _, line in imports(path) if module.split(".")[0] == "toolkit"]
    assert not found, f"{label(path)} imports the toolkit on lines {found}"


@pytest.mark.parametrize("path", [path for path in TOOLKIT if path.parent != CLI], ids=label)
def test_the_toolkit_knows_no_robot_by_name(path):
    """Concrete robots and grippers come in as arguments; only the command line looks names up."""
    allowed = {"robots.robot", "robots.model_robot", "grippers.gripper"}
    found = [f"{module}{'.' + name if name else ''} (line {line})" for module, name, line in imports(path)
             if module.split(".")[0] in ("robots", "grippers") and module not in allowed]
    assert not found, f"{label(path)} imports {found}"


@pytest.mark.parametrize("path", [*TOOLKIT, *LEAVES], ids=label)
def test_nothing_imports_the_public_name(path):
    """It stands on all others; whoever imported it would import all of them."""
    found = [line for module, _, line in imports(path) if module.split(".")[0] == "meta_evolve"]
    assert not found, f"{label(path)} imports meta_evolve on lines {found}"


@every_file
def test_only_the_recording_imports_rerun(path):
    found = [line for module, _, line in imports(path) if module.split(".")[0] == "rerun"]
    assert not found or label(path).startswith(MAY_IMPORT_RERUN), f"{label(path)} imports rerun on lines {found}"


@every_file
def test_no_bare_except(path):
    found = [node.lineno for node in ast.walk(tree(path)) if isinstance(node, ast.ExceptHandler) and node.type is None]
    assert not found, f"{label(path)} has a bare except on lines {found}"


@every_file
def test_no_print_but_the_command_lines(path):
    found = [line for name, line, _ in calls(path) if name == "print"]
    assert not found or path.parent == CLI, f"{label(path)} prints on lines {found}"


@every_file
def test_nothing_can_run_code_from_a_file(path):
    banned = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "joblib"}
    found = [f"import {module} (line {line})" for module, _, line in imports(path) if module.split(".")[0] in banned]
    for name, line, node in calls(path):
        keywords = {k.arg: ast.unparse(k.value) for k in node.keywords}
        if name in RUNS_CODE:
            found.append(f"{name} (line {line})")
        if keywords.get("allow_pickle", "False") != "False" or keywords.get("shell", "False") != "False":
            found.append(f"{name} with {keywords} (line {line})")
    assert not found, f"{label(path)}: {found}"


@every_file
def test_every_public_thing_is_documented(path):
    undocumented = [] if ast.get_docstring(tree(path)) or not path.read_text().strip() else ["the module"]
    for node in tree(path).body:
        public = isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")
        overload = any(ast.unparse(decorator) == "overload" for decorator in getattr(node, "decorator_list", ()))
        if public and not overload and not ast.get_docstring(node):
            undocumented.append(node.name)
    assert not undocumented, f"{label(path)}: no docstring for {undocumented}"


# -- the order of docs/architecture.md -----------------------------------------------------------------------


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def toolkit_edges():
    """(importer, imported, line) among the toolkit's modules."""
    modules = {module_name(path) for path in TOOLKIT}
    for path in TOOLKIT:
        for module, name, line in imports(path):
            target = f"{module}.{name}" if name and f"{module}.{name}" in modules else module
            if target in modules and target != module_name(path):
                yield module_name(path), target, line


def test_no_module_imports_itself_in_a_circle():
    graph = {}
    for importer, imported, _ in toolkit_edges():
        graph.setdefault(importer, set()).add(imported)

    def reach(module, seen):
        for target in graph.get(module, ()):
            if target not in seen:
                seen.add(target)
                reach(target, seen)
        return seen

    circles = sorted(module for module in graph if module in reach(module, set()))
    assert not circles, f"{circles} import one another in a circle"


def architecture():
    """Names of the toolkit's modules in the order of docs/architecture.md, and its rooms in theirs."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    modules, rooms = [], []
    for line in text.splitlines():
        if found := re.match(r" {4}toolkit/(\w+)(/|\.py) ", line):
            rooms.append(found[1])
            modules += [f"toolkit.{found[1]}"]
        elif re.match(r" {8}\w", line):
            modules += [f"toolkit.{rooms[-1]}.{name.replace('/', '.')}" for name in line.split()]
    return modules, rooms


def test_the_architecture_lists_every_module_once():
    modules, rooms = architecture()
    packages = {module_name(path) for path in TOOLKIT if path.name == "__init__.py"}
    there = {module_name(path) for path in TOOLKIT} - packages
    listed = {module for module in modules if module not in packages}
    assert len(modules) == len(set(modules)) and len(rooms) > 10, "docs/architecture.md lists a module twice, or in another form"
    missing = sorted(module for module in there - listed if not module.startswith("toolkit.cli."))
    assert not missing and listed <= there, f"docs/architecture.md lacks {missing}, and has {sorted(listed - there)} that are not there"
    assert {path.parent.name for path in (ROOT / "toolkit").glob("*/__init__.py")} <= set(rooms)


def test_no_module_stands_outside_the_rooms():
    loose = {path.stem for path in (ROOT / "toolkit").glob("*.py")}
    assert loose == {"__init__", "errors", "quiet", "doctor"}, f"{loose} stand in toolkit/ itself"


def test_modules_import_upwards_in_the_architectures_order():
    """Rooms from rooms above, and files from files before them in their room."""
    modules, rooms = architecture()
    packages = {module_name(path) for path in TOOLKIT if path.name == "__init__.py"}
    place = {room: index for index, room in enumerate(rooms)}
    rank = {module: index for index, module in enumerate(modules) if module not in packages}
    wrong = []
    for a, b, line in toolkit_edges():
        ours, theirs = (module.split(".")[1] if "." in module else None for module in (a, b))
        upwards = ours in place and theirs in place and place[theirs] > place[ours]
        if upwards or (a in rank and b in rank and rank[b] >= rank[a]):
            wrong.append(f"{a} imports {b} (line {line})")
    assert not wrong, f"against docs/architecture.md: {wrong}"


def test_a_robots_computer_needs_few_rooms():
    """deploy, and bundle beneath it, import the light rooms alone."""
    light = ("toolkit.deploy", "toolkit.bundle", "toolkit.io", "toolkit.runs.seeds", "toolkit.errors")
    wrong = [f"{a} imports {b} (line {line})" for a, b, line in toolkit_edges() if a.startswith(("toolkit.deploy", "toolkit.bundle"))
             and not b.startswith(light) and b != "toolkit.learning.policy"]
    assert not wrong, f"{wrong}; the writer of ONNX graphs alone takes a policy, when it is called"


VIEWER = ("torch", "rerun", "onnx", "onnxruntime")


@pytest.mark.parametrize("module, heavy", [
    *((f"toolkit.morphology.{name}", VIEWER) for name in ("matching", "lab", "survey")),
    ("toolkit.evolution", (*VIEWER, "robosuite", "mujoco")),
    ("toolkit.deploy.runtime", ("torch", "rerun", "robosuite", "gymnasium")),
])
def test_nothing_heavy_is_loaded_without_need(module, heavy):
    """Matching and trees ask for neither learner nor viewer, the arm's runtime for no simulation. By what is loaded, so that a slow machine
    changes nothing."""
    code = f"import sys, {module}; print([name for name in {heavy!r} if name in sys.modules])"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().splitlines()[-1] == "[]", f"import {module} loads {done.stdout.strip()}"


@pytest.mark.slow
def test_training_code_needs_no_rerun():
    program = "import sys, toolkit.runs.phases, toolkit.runs.run, toolkit.transfer.pipeline; sys.exit('rerun' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}).returncode == 0


# -- tests mirror the toolkit --------------------------------------------------------------------------------

WITHOUT_TESTS = {
    "errors": "one class and no code; every test of a refusal catches it",
    "cli/__main__": "two lines that call the command line, as tests of whole commands do",
}
"""Modules that need no test file, each with why."""
ACROSS_MODULES = {
    "layers": "the order of all modules, and this",
    "meta_evolve": "the public name, which stands beside toolkit/",
    "cli/batches": "one bad item of many, whatever the command",
    "cli/cluster": "--cluster, of every command that has it",
    "cli/exits": "exit statuses, of every command",
    "cli/markup": "names are data wherever they are shown",
    "cli/outputs": "optional outputs, of every command",
    "deploy/absent": "what a vendor reports as absent, for every driver",
    "deploy/turns": "angles that repeat themselves, from observer to driver",
    "expert/imitation": "an expert from recorded steps, from file to shelf",
    "export/clients": "the twin with its driver and strangers at either end of the wire",
    "inspection/family": "a run of a family's robots, from recording to film",
    "inspection/lazy_reads": "what opens well and fails further on, whoever reads it",
    "simulation/cluster_faults": "what goes wrong between engine, cluster and nodes",
}
"""Test files of a property of several modules, each with which."""


def mirrored():
    """(modules and packages of toolkit/, modules alone, names of the test files in folders of the same names)."""
    named = lambda paths, root: {path.relative_to(root).with_suffix("").as_posix() for path in paths}  # noqa: E731
    packages = {path.parent for path in TOOLKIT if path.name == "__init__.py"}
    modules = named((path for path in TOOLKIT if path.name != "__init__.py"), ROOT / "toolkit")
    folders = [ROOT / "tests" / package.relative_to(ROOT / "toolkit") for package in packages]
    files = [file.with_name(file.name.removeprefix("test_")) for folder in folders for file in folder.glob("test_*.py")]
    tested = named(files, ROOT / "tests")
    return modules | named(packages - {ROOT / "toolkit"}, ROOT / "toolkit"), modules, tested


def test_every_module_has_a_test_file_of_its_own():
    _, modules, tested = mirrored()
    missing, needless = modules - tested - set(WITHOUT_TESTS), set(WITHOUT_TESTS) & tested | set(WITHOUT_TESTS) - modules
    assert not missing, f"write tests/<room>/test_<module>.py of {sorted(missing)}"
    assert not needless, f"WITHOUT_TESTS names {sorted(needless)}, which has tests or is not there"


def test_no_test_file_is_named_for_a_module_that_is_not_there():
    there, _, tested = mirrored()
    strange, needless = tested - there - set(ACROSS_MODULES), set(ACROSS_MODULES) - tested | set(ACROSS_MODULES) & there
    assert not strange, f"tests/ mirrors toolkit/: move what tests one module to its file, or name {sorted(strange)} in ACROSS_MODULES"
    assert not needless, f"ACROSS_MODULES names {sorted(needless)}, which is not there or is a module's own"
