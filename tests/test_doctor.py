"""The doctor finds this machine well, and says so rather than failing where it is not."""

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
    assert {"off-screen rendering", "Rerun recording", "logs folder"} <= set(found)


def test_every_problem_has_a_mend_and_nothing_else_has(found: dict[str, doctor.Check]) -> None:
    assert all(bool(check.mend) == (check.ok is not True) for check in found.values())


@pytest.mark.parametrize("version, good", [("3.7.0", True), ("3.7.1", True), ("3.6.0", False), ("3.8.0", False), ("3.10.1", False)])
def test_versions_against_the_tested_range(monkeypatch: pytest.MonkeyPatch, version: str, good: bool) -> None:
    monkeypatch.setattr(metadata, "version", lambda package: version)
    check = doctor._package("mujoco")
    assert check.ok is good
    assert good or check.mend == 'pip install "mujoco>=3.7,<3.8"'


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
