"""Can this machine run the toolkit? One record per question, each with its mend; nothing here raises or prints."""

import importlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

PYTHON = (3, 11)
TESTED: dict[str, tuple[str, str | None]] = {  # package -> from, and below
    "mujoco": ("3.7", "3.8"),  # 3.8 lets robosuite's Robotiq-85 drop what it holds
    "robosuite": ("1.5.1", "1.5.2"),  # 1.5.2 pins mink 0.0.5, and with it an old numpy, pin and rerun
    "mink": ("1.0", "1.2"),  # 1.2 needs mujoco 3.8
    "pin": ("4.0", None),
    "rerun-sdk": ("0.40", None),
    "torch": ("2.0", None),
    "numpy": ("2.0", None),
    "gymnasium-robotics": ("1.4", None),
    "numba": ("0.60", None),
    "safetensors": ("0.4", None),
    "onnx": ("1.16", None),
    "onnxruntime": ("1.18", None),
    "scipy": ("0", None),
    "llvmlite": ("0", None),
    "pyyaml": ("6", None),
    "matplotlib": ("0", None),
    "pillow": ("10.1", None),
    "opencv-python": ("0", None),
    "tyro": ("0", None),
    "rich": ("0", None),
}
OPTIONAL = {"rerun-sdk": "pip install 'meta-evolve[viewer]', to look at runs"}
ROBOTS = ("Jaco", "Kinova3", "IIWA")
RENDER_PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><light pos='0 0 2'/><geom size='.3'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 32, 32) as renderer:
    renderer.update_scene(data)
    assert renderer.render().max() > 0, "the picture is black"
    from OpenGL import GL
    print("\\n" + GL.glGetString(GL.GL_RENDERER).decode())
"""
VULKAN_PROBE = """
import ctypes
vulkan = ctypes.CDLL("libvulkan.so.1")
class Asked(ctypes.Structure):  # VkInstanceCreateInfo
    _fields_ = [("type", ctypes.c_int), ("next", ctypes.c_void_p), ("flags", ctypes.c_uint32), ("application", ctypes.c_void_p),
                ("layers", ctypes.c_uint32), ("layer_names", ctypes.c_void_p), ("extensions", ctypes.c_uint32), ("names", ctypes.c_void_p)]
instance, count = ctypes.c_void_p(), ctypes.c_uint32()
assert vulkan.vkCreateInstance(ctypes.byref(Asked(type=1)), None, ctypes.byref(instance)) == 0, "no driver takes a Vulkan instance"
assert vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None) == 0 and count.value, "no driver has a device"
devices = (ctypes.c_void_p * count.value)()
vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), devices)
about = ctypes.create_string_buffer(4096)  # VkPhysicalDeviceProperties: its name stands behind five whole numbers
vulkan.vkGetPhysicalDeviceProperties(ctypes.c_void_p(devices[0]), about)
print(about[20:276].split(b"\\0")[0].decode())
"""
STILL = 320, 200
"""[pixels] of the still that is taken."""
PAINT = (213, 94, 0)
ROOM, LEAST = 2e9, 64e6
"""[bytes] that a few runs and their recordings need, and without which none begins."""
ROBOT_PROBE = """
import json, logging, sys
logging.disable(logging.CRITICAL)
import mujoco
from robosuite.models.robots import create_robot
answer = {}
for name in json.loads(sys.argv[1]):
    try:
        model = create_robot(name, idn=0).get_model(mode="mujoco")
        answer[name] = f"{model.nbody} bodies, {model.njnt} joints"
    except Exception as error:
        answer[name] = f"!{type(error).__name__}: {error}"
print("\\n" + json.dumps(answer))
"""


class Check(NamedTuple):
    """One question about this machine.

    Attributes:
        name: what was looked at.
        ok: True; False if the toolkit cannot work so; None for a warning: all but this works.
        detail: what was found.
        mend: a command or a sentence; empty if ok.
    """

    name: str
    ok: bool | None
    detail: str
    mend: str


def checks(logs: Path | str = "logs") -> list[Check]:
    """Look at everything; takes some seconds, most of them loading robosuite and Rerun.

    Args:
        logs: the folder where runs will be written.
    """
    found = [_guarded("python", _python, "install Python 3.11 or newer")]
    found += [_guarded(package, partial(_package, package), _install(package)) for package in TESTED]
    found.append(_guarded("ADROIT hand", _adroit, "pip install --force-reinstall gymnasium-robotics"))
    found += _robots()
    found.append(_guarded("off-screen rendering", _rendering, "leave out pictures and videos, or install EGL or OSMesa"))
    if sys.platform == "linux":  # elsewhere the viewer draws with what the system has
        found.append(_guarded("Vulkan", _vulkan, VULKAN_MEND))
    if importlib.util.find_spec("rerun") is not None:
        found.append(_guarded("Rerun recording", _recording, "pip install --force-reinstall rerun-sdk"))
        found.append(_guarded("a still of the viewer", _still, VULKAN_MEND))
    found.append(_guarded("logs folder", lambda: _logs(Path(logs)), f"choose a folder you may write to with --run, not {logs}"))
    found.append(_guarded("temporary folder", _temporary, "set TMPDIR to a folder you may write to"))
    found.append(_guarded("free disk", lambda: _disk(Path(logs)), f"free some, or choose a folder on another disk with --run, not {logs}"))
    return found


def _guarded(name: str, question: Callable[[], Check], mend: str) -> Check:
    """The question's answer; whatever it raises is the answer too."""
    try:
        return question()
    except (Exception, SystemExit) as error:  # a broken package may raise anything while it is imported
        return Check(name, False, _brief(f"{type(error).__name__}: {error}"), mend)


def _python() -> Check:
    version = ".".join(map(str, sys.version_info[:3]))
    good = sys.version_info[:2] >= PYTHON
    return Check("python", good, version, "" if good else "install Python 3.11 or newer")


def _package(package: str) -> Check:
    lowest, below = TESTED[package]
    wanted = "any version" if lowest == "0" else f"tested with {lowest} or newer" + (f", below {below}" if below else "")
    try:
        version = metadata.version(package)
    except metadata.PackageNotFoundError:
        return Check(package, None if package in OPTIONAL else False, f"not installed; {wanted}", OPTIONAL.get(package, _install(package)))
    good = _key(version) >= _key(lowest) and (below is None or _key(version) < _key(below))
    return Check(package, good, version if good else f"{version}; {wanted}", "" if good else _install(package))


def _install(package: str) -> str:
    lowest, below = TESTED[package]
    if lowest == "0":
        return f"pip install {package}"
    return f'pip install "{package}>={lowest}{f",<{below}" if below else ""}"'


def _key(version: str) -> tuple[int, ...]:
    """Comparable numbers of a version: "2.13.0+cpu" and "2.13rc1" -> (2, 13, 0)."""
    numbers = [int(re.findall(r"^\d*", part)[0] or 0) for part in version.split("+")[0].split(".")[:3]]
    return tuple(numbers + [0] * (3 - len(numbers)))


def _adroit() -> Check:
    mend = _install("gymnasium-robotics")
    spec = importlib.util.find_spec("gymnasium_robotics")
    if spec is None or not spec.submodule_search_locations:
        return Check("ADROIT hand", False, "gymnasium_robotics is not installed", mend)
    assets = Path(spec.submodule_search_locations[0]) / "envs" / "assets"
    needed = [assets / "adroit_hand" / "adroit_model.xml", assets / "adroit_hand" / "adroit_assets.xml"]
    missing = [file.name for file in needed if not file.is_file()]
    if missing:
        return Check("ADROIT hand", False, f"missing {', '.join(missing)}", f"pip install --force-reinstall {mend.split()[-1]}")
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(needed[0].with_name("adroit_relocate.xml")))
    return Check("ADROIT hand", True, f"{model.nbody} bodies, {model.njnt} joints", "")


def _robots() -> list[Check]:
    """One per arm, in a process of their own: robosuite prints when it is imported, and a fault in it ends there."""

    mend = f'{_install("robosuite")} {_install("mujoco").split()[-1]}'
    try:
        answer = _run(ROBOT_PROBE, json.dumps(ROBOTS))
        failed = dict.fromkeys(ROBOTS, "!" + _last_line(answer.stderr))
        found = failed if answer.returncode != 0 else json.loads(answer.stdout.splitlines()[-1])
    except (OSError, subprocess.SubprocessError, ValueError, IndexError) as error:
        found = dict.fromkeys(ROBOTS, f"!{error}")
    return [
        Check(f"robosuite {name}", not text.startswith("!"), _brief(text.lstrip("!")), mend if text.startswith("!") else "")
        for name, text in found.items()
    ]


def _rendering() -> Check:
    """Tried in a process of its own, since a missing driver can end it; a warning only, as training needs no pictures."""
    asked = os.environ.get("MUJOCO_GL")
    backends = [asked] if asked else ["egl", "osmesa"] if sys.platform == "linux" else [""]
    problem = ""
    for backend in backends:
        answer = _run(RENDER_PROBE, MUJOCO_GL=backend)
        if answer.returncode == 0:
            detail = f"MUJOCO_GL={backend}" if backend else "the system's own"
            return Check("off-screen rendering", True, f"{detail}: {_last_line(answer.stdout)}", "")
        problem += f"MUJOCO_GL={backend}: {_last_line(answer.stderr)}; "
    mend = (
        "apt-get install libegl1 libosmesa6 (Debian, Ubuntu), then set MUJOCO_GL to egl or osmesa; "
        "only pictures and videos need it"
    )
    return Check("off-screen rendering", None, _brief(problem.rstrip("; ")), mend)


VULKAN_MEND = ("apt-get install mesa-vulkan-drivers libvulkan1 libegl1 (Debian, Ubuntu; a driver that needs no graphics card); "
               "only stills and the viewer's window need it")


def _vulkan() -> Check:
    """Which device draws for the viewer; in a process of its own, as a driver may end it."""
    answer = _run(VULKAN_PROBE)
    if answer.returncode == 0:
        return Check("Vulkan", True, _brief(answer.stdout), "")
    return Check("Vulkan", None, _brief(_last_line(answer.stderr)), VULKAN_MEND)


def _still() -> Check:
    """A picture of a recording as `view --still` takes it, on which what was recorded is seen."""
    import numpy as np
    import rerun as rr
    import rerun.blueprint as rrb
    from matplotlib.image import imread

    from toolkit.errors import ToolkitError
    from toolkit.inspection.recording.layout import quiet_layout
    from toolkit.inspection.recording.stream import FILM, Stream
    from toolkit.inspection.recording.viewer import still

    name = "a still of the viewer"
    with tempfile.TemporaryDirectory() as folder:
        file, picture = Path(folder) / "still.rrd", Path(folder) / "still.png"
        stream = Stream(file)
        stream.arrange(quiet_layout(rrb.Spatial2DView(origin="paint"), FILM))
        stream.static("paint", rr.Image(np.full((20, 32, 3), PAINT, np.uint8)))
        stream.close()
        began = time.monotonic()
        try:
            still([file], picture, None, "x".join(map(str, STILL)))
        except ToolkitError as error:
            return Check(name, None, _brief(str(error)), VULKAN_MEND)
        pixels = np.round(255 * imread(picture)[..., :3])
    painted = (np.abs(pixels - PAINT).max(axis=-1) < 8).mean()
    detail = f"{pixels.shape[1]} by {pixels.shape[0]} pixels in {time.monotonic() - began:.1f} s, {painted:.0%} of them as painted"
    good = painted > 0.2
    return Check(name, True if good else None, detail, "" if good else VULKAN_MEND)


def _recording() -> Check:
    import rerun as rr

    from toolkit.inspection.recording.stream import Stream
    from toolkit.inspection.recording.viewer import chunks_of

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "probe.rrd"
        stream = Stream(file)
        stream.row("probe", 0.0, 0, rr.Scalars(1.0))
        stream.close()
        good = any(chunk.entity_path == "/probe" for chunk in chunks_of(file))
        size = file.stat().st_size
    mend = "" if good else "pip install --force-reinstall rerun-sdk"
    return Check("Rerun recording", good, f"{size} bytes written and read back" if good else "what was written is not there", mend)


def _logs(folder: Path) -> Check:
    """Asks the nearest existing parent, so that looking makes no folder."""
    existing = next(parent for parent in [folder.absolute(), *folder.absolute().parents] if parent.exists())
    try:
        with tempfile.TemporaryFile(dir=existing):
            return Check("logs folder", True, str(folder), "")
    except OSError as error:
        return Check("logs folder", False, f"{folder}: {error.strerror}", f"chmod u+w {existing}, or choose another folder with --run")


def _temporary() -> Check:
    folder = tempfile.gettempdir()
    with tempfile.TemporaryFile(dir=folder):
        return Check("temporary folder", True, folder, "")


def _disk(folder: Path) -> Check:
    existing = next(parent for parent in [folder.absolute(), *folder.absolute().parents] if parent.exists())
    free = shutil.disk_usage(existing).free
    good = True if free >= ROOM else None if free >= LEAST else False
    mend = f"free at least {ROOM / 1e9:.0f} GB there, or choose a folder on another disk with --run"
    return Check("free disk", good, f"{free / 1e9:.1f} GB under {existing}", "" if good else mend)


def _run(program: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", program, *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        env=os.environ | environment,
        check=False,
    )


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["no message"])[-1]


def _brief(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= 200 else line[:197] + "..."
