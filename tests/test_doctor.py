"""The doctor finds this machine well, and says so rather than failing where it is not."""

import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from toolkit import doctor


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, doctor.Check]:
    return {check.name: check for check in doctor.checks(tmp_path_factory.mktemp("doctor") / "logs")}


def test_a_working_installation_passes(found: dict[str, doctor.Check]) -> None:
    broken = [check for check in found.values() if check.ok is False]
    assert not broken, broken
    assert {"python", *doctor.TESTED, "ADROIT hand", "robosuite Jaco", "robosuite Kinova3", "robosuite IIWA"} <= set(found)
    assert {"off-screen rendering", "Vulkan", "Rerun recording", "a still of the viewer", "logs folder", "free disk"} <= set(found)


def test_every_problem_has_a_mend_and_nothing_else_has(found: dict[str, doctor.Check]) -> None:
    assert all(bool(check.mend) == (check.ok is not True) for check in found.values())


@pytest.mark.parametrize("version, good", [("3.7.0", True), ("3.7.1", True), ("3.6.0", False), ("3.8.0", False), ("3.10.1", False)])
def test_versions_against_the_tested_range(monkeypatch: pytest.MonkeyPatch, version: str, good: bool) -> None:
    monkeypatch.setattr(metadata, "version", lambda package: version)
    check = doctor._package("mujoco")
    assert check.ok is good
    assert good or check.mend == 'pip install "mujoco>=3.7,<3.8"'


def test_the_viewer_may_be_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(package: str) -> str:
        raise metadata.PackageNotFoundError(package)

    monkeypatch.setattr(metadata, "version", absent)
    check = doctor._package("rerun-sdk")
    assert check.ok is None and "meta-evolve[viewer]" in check.mend


def test_an_absent_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(package: str) -> str:
        raise metadata.PackageNotFoundError(package)

    monkeypatch.setattr(metadata, "version", absent)
    check = doctor._package("pin")
    assert check.ok is False and "not installed" in check.detail and check.mend == 'pip install "pin>=4.0"'


def test_a_failing_renderer_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "RENDER_PROBE", "raise RuntimeError('no driver')")
    check = doctor._rendering()
    assert check.ok is None and "no driver" in check.detail and "apt-get install" in check.mend


def test_every_dependency_is_looked_at_in_the_range_that_is_installed() -> None:
    """What pyproject.toml asks for is what the doctor asks for."""
    from packaging.requirements import Requirement

    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    asked = {r.name: r.specifier for r in map(Requirement, [*project["dependencies"], *project["optional-dependencies"]["viewer"]])}
    assert set(asked) == set(doctor.TESTED)
    for name, specifier in asked.items():
        lowest, below = doctor.TESTED[name]
        bounds = {s.operator: s.version for s in specifier}
        if "==" not in bounds:
            assert (bounds.get(">=", "0"), bounds.get("<")) == (lowest, below) or doctor._key(bounds[">="]) == doctor._key(lowest), name
        assert specifier.contains(lowest) or lowest == "0", name


def test_a_still_is_looked_at_and_not_only_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """A viewer that saves a black picture is no working viewer, and one that cannot draw is told with its mend."""
    from PIL import Image

    from toolkit.errors import ToolkitError
    from toolkit.inspection.recording import viewer

    monkeypatch.setattr(viewer, "still", lambda files, out, at, size: Image.new("RGB", doctor.STILL).save(out))
    check = doctor._still()
    assert check.ok is None and "0% of them as painted" in check.detail and "mesa-vulkan-drivers" in check.mend

    def refuse(*_: object) -> None:
        raise ToolkitError(viewer.CANNOT_DRAW)

    monkeypatch.setattr(viewer, "still", refuse)
    check = doctor._still()
    assert check.ok is None and "cannot draw" in check.detail and "mesa-vulkan-drivers" in check.mend


def test_a_missing_vulkan_driver_is_a_warning(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "none.json"))
    monkeypatch.setenv("VK_ICD_FILENAMES", str(tmp_path / "none.json"))
    check = doctor._vulkan()
    assert check.ok is None and "mesa-vulkan-drivers" in check.mend


@pytest.mark.parametrize("free, ok", [(50e9, True), (1e9, None), (1e6, False)])
def test_a_full_disk_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, free: float, ok: bool | None) -> None:
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: type("Usage", (), {"free": free})())
    check = doctor._disk(tmp_path / "new" / "logs")
    assert check.ok is ok and bool(check.mend) == (ok is not True)


def test_robots_that_do_not_load_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "ROBOT_PROBE", "raise SystemExit('robosuite is broken')")
    assert [check.ok for check in doctor._robots()] == [False] * 3
    assert all("robosuite is broken" in check.detail and "pip install" in check.mend for check in doctor._robots())


def test_a_check_never_raises() -> None:
    def broken() -> doctor.Check:
        raise SystemExit("a package that leaves on import")

    assert doctor._guarded("anything", broken, "mend it") == doctor.Check(
        "anything", False, "SystemExit: a package that leaves on import", "mend it"
    )


def test_logs_where_a_file_stands(tmp_path: Path) -> None:
    (tmp_path / "logs").write_text("a file")
    check = doctor._guarded("logs folder", lambda: doctor._logs(tmp_path / "logs"), "choose another")
    assert check.ok is False and check.mend
    assert doctor._logs(tmp_path / "new" / "logs").ok and not (tmp_path / "new").exists()
