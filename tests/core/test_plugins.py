"""Entry points and versions of installed packages."""

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from fieldkit import __version__
from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError
from tests.helpers.outside_packages import write_package


def test_entry_points_are_sorted_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_package(tmp_path, "first", "[bench]\nlast = a.b:c\nmiddle = a.b:d [extra]\n")
    write_package(tmp_path, "second", "[bench]\nearly = e.f:g\n[other]\nelse = h:i\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert [point.name for point in plugins.entry_points("bench")] == ["early", "last", "middle"]


def test_the_first_of_two_versions_of_a_package_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for version in ("1.0", "2.0"):
        write_package(tmp_path / version, "bench-tools", f"[bench]\nbench = bench.v{version[0]}:run\n", version)
        monkeypatch.syspath_prepend(tmp_path / version)
    assert [point.value for point in plugins.entry_points("bench")] == ["bench.v2:run"]
    assert plugins.version("Bench.Tools") == "2.0"


def test_versions_include_packages_that_add_backends_or_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_package(tmp_path, "more-steps", f"[{plugins.STEPS}]\nload = more_steps:Load\n", "1.5")
    write_package(tmp_path, "more-commands", f"[{plugins.COMMANDS}]\nplay = more_commands:play\n", "3.0")
    monkeypatch.syspath_prepend(tmp_path)
    assert plugins.versions() == {"fieldkit": __version__, "more-steps": "1.5"}


def test_a_package_that_is_not_installed_has_an_unknown_version() -> None:
    assert plugins.version("no-such-package") == "unknown"


@pytest.mark.parametrize("value", ["fieldkit.core.no_such_module:x", "fieldkit.core.plugins:x", "not a module"])
def test_an_entry_point_that_cannot_be_loaded_is_named(value: str) -> None:
    with pytest.raises(ConfigurationError, match="it cannot be loaded") as error_info:
        plugins.load(EntryPoint("broken", value, "bench"))
    assert error_info.value.where == f"entry point broken = {value}"


def test_an_entry_point_names_a_module_or_an_attribute_in_one() -> None:
    module = EntryPoint("a", "fieldkit.core.plugins", "bench")
    attribute = EntryPoint("b", "fieldkit.core.errors:ConfigurationError.exit_code [extra]", "bench")
    assert plugins.load(module) is plugins
    assert plugins.load(attribute) == ConfigurationError.exit_code
