"""What installed packages say of themselves, beside what Python's own reader of it finds."""

from importlib import metadata
from pathlib import Path

import pytest

from fieldkit.core import plugins
from tests.helpers.outside_packages import write_package


@pytest.mark.parametrize("group", [plugins.BACKENDS, plugins.COMMANDS, "console_scripts", "pytest11"])
def test_entry_points_are_those_that_python_itself_finds(group: str) -> None:
    found = {(point.name, point.value) for point in plugins.points(group)}
    assert found == {(point.name, point.value) for point in metadata.entry_points(group=group)}
    assert found


@pytest.mark.parametrize("package", ["fieldkit", "numpy", "PyYAML", "ruamel-yaml", "typing_extensions"])
def test_a_version_is_what_python_itself_finds(package: str) -> None:
    assert plugins.version(package) == metadata.version(package)


def test_a_package_that_is_not_there_has_no_known_version() -> None:
    assert plugins.version("no-such-package") == "unknown"


def test_of_two_versions_of_a_package_the_first_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for version in ("1.0", "2.0"):
        write_package(tmp_path / version, "bench-tools", f"[bench]\nbench = bench.v{version[0]}:run\n", version)
        monkeypatch.syspath_prepend(tmp_path / version)
    assert [point.value for point in plugins.points("bench")] == ["bench.v2:run"]
    assert [point.value for point in metadata.entry_points(group="bench")] == ["bench.v2:run"]
    assert plugins.version("Bench.Tools") == metadata.version("Bench.Tools") == "2.0"


def test_files_that_are_not_as_they_should_be_say_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_package(tmp_path, "first", "; a comment\n# bench = of:it\nno group\n[bench]\nlast = a.b:c.d [extra]\n")
    (tmp_path / "second-1.0.dist-info").write_bytes(b"no folder")
    (tmp_path / "third-1.0.dist-info").mkdir()
    (tmp_path / "third-1.0.dist-info" / "entry_points.txt").write_bytes(b"\xff\xfe")
    monkeypatch.syspath_prepend(tmp_path)
    assert [point.name for point in plugins.points("bench")] == ["last"]
    assert plugins.version("third") == "unknown"


def test_an_entry_point_may_stand_for_a_module_or_for_what_is_deep_in_one() -> None:
    module = plugins.EntryPoint("a", "fieldkit.core.plugins", "bench")
    deep = plugins.EntryPoint("b", "fieldkit.core.plugins : EntryPoint.count [extra]", "bench")
    assert plugins.load(module) is plugins
    assert plugins.load(deep) is plugins.EntryPoint.count
