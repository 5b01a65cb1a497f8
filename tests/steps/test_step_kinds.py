"""Kinds of step: built-in kinds, kinds of entry points, and errors of entry points."""

from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path

import pytest
from pydantic import TypeAdapter, ValidationError

from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError
from fieldkit.steps import kinds
from fieldkit.steps.base import StepEntry, step_types
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.trial.columns import installed_columns
from tests.helpers.outside_packages import write_package

BUILTIN = ["capture", "transfer", "ping", "fault", "wait", "ask", "together", "run", "iperf3", "soak", "send", "roam"]
MOTION = ["fly", "mavlink", "move"]
ROS = ["record", "topics", "track", "video"]

Install = Callable[..., None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """A function that installs a package with entry points; each keyword is a name with the target as its value."""

    def install_package(**targets: str) -> None:
        entry_points = "".join(f"{name} = {target}\n" for name, target in targets.items())
        write_package(tmp_path / "installed", "more-steps", f"[{plugins.STEPS}]\n{entry_points}")
        monkeypatch.syspath_prepend(tmp_path / "installed")

    cached_functions = (step_types, installed_columns)
    for function in cached_functions:
        function.cache_clear()
    yield install_package
    for function in cached_functions:
        function.cache_clear()


@pytest.mark.motion
@pytest.mark.ros
def test_builtin_kinds_are_in_order_and_in_modules_with_their_names(install: Install) -> None:
    install()
    assert list(step_types()) == [*BUILTIN, *MOTION, *ROS]
    assert kinds.shipped_names() == {*BUILTIN, *MOTION, *ROS}
    for kind in BUILTIN:
        step = step_types()[kind]
        assert (step.__module__, step.__name__) == (f"fieldkit.steps.kinds.{kind}", f"{kind.capitalize()}Step")


@pytest.mark.motion
@pytest.mark.ros
def test_kinds_from_packages_are_sorted_by_name(install: Install) -> None:
    install(zoom="fieldkit.steps.kinds.ping:PingStep", load="fieldkit.steps.kinds.ping:PingStep")
    assert list(step_types()) == [*BUILTIN, "fly", "load", "mavlink", "move", *ROS, "zoom"]
    assert step_types()["load"] is PingStep


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("no_such_package.steps:Load", "No module named 'no_such_package'"),
        ("fieldkit.steps.kinds.ping:NoSuchStep", "has no attribute 'NoSuchStep'"),
        ("half_written:Load", "SyntaxError: '\\(' was never closed"),
        ("unmet:Load", "ZeroDivisionError"),
    ],
)
def test_error_of_entry_point_that_cannot_be_loaded_names_it(
    install: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, target: str, message: str
) -> None:
    (tmp_path / "half_written.py").write_text("class Load(", encoding="utf-8")
    (tmp_path / "unmet.py").write_text("1 / 0", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    install(load=target)
    assert "load" in step_types()
    with pytest.raises(ConfigurationError, match=message) as caught:
        step_types()["load"]
    assert caught.value.what.startswith("it cannot be loaded: ")
    assert caught.value.where == f"entry point load = {target} of more-steps 1.0"
    assert caught.value.remedy == "fix or uninstall its package"


def test_a_kind_is_imported_when_it_is_used(install: Install) -> None:
    install(broken="no_such_package.steps:Broken")
    ping = {"from": "sender", "to": "receiver"}
    (entry,) = TypeAdapter(tuple[StepEntry, ...]).validate_python([{"ping": ping}])
    assert type(entry.step) is PingStep
    with pytest.raises(ConfigurationError, match="No module named 'no_such_package'"):
        TypeAdapter(tuple[StepEntry, ...]).validate_python([{"broken": {}}])


@pytest.mark.parametrize("target", ["os.path:join", "fieldkit.steps.base:View", "fieldkit.steps.kinds.ping"])
def test_entry_point_without_step_class_is_rejected(install: Install, target: str) -> None:
    install(load=target)
    with pytest.raises(ConfigurationError, match="a kind of step must be a subclass of Step") as caught:
        step_types()["load"]
    assert caught.value.where == f"entry point load = {target} of more-steps 1.0"


def test_builtin_kind_cannot_be_replaced(install: Install) -> None:
    install(ping="no_such_package.steps:Ping")
    with pytest.raises(ConfigurationError, match="there is already a kind of step 'ping'") as caught:
        step_types()
    assert caught.value.where == "entry point ping = no_such_package.steps:Ping of more-steps 1.0"


def test_abstract_class_is_rejected(install: Install) -> None:
    install(load="fieldkit.steps.program:ProgramStep")
    with pytest.raises(ConfigurationError, match="the kind of step lacks argv, parse"):
        step_types()["load"]


@pytest.mark.ros
def test_class_with_only_a_part_of_a_capability_is_rejected(install: Install) -> None:
    install(load="tests.steps.test_step_capabilities:Partial")
    with pytest.raises(ConfigurationError, match="only a part of a capability: it lacks records_on, with_record"):
        step_types()["load"]


@pytest.mark.parametrize("name", ["rtt_sent", "status"])
def test_column_name_that_is_already_used_is_rejected(
    install: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / f"declares_{name}.py").write_text(
        "from fieldkit.core.columns import columns\nfrom fieldkit.steps.kinds.ping import PingStep\n"
        f"class Load(PingStep):\n    columns = columns(100, ('{name}', 'processes', 'Processes that ran.'))\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(tmp_path)
    install(load=f"declares_{name}:Load")
    with pytest.raises(
        ConfigurationError, match=f"'load' declares a column '{name}', which exists already"
    ) as caught:
        installed_columns()
    assert caught.value.remedy == "rename it there, or uninstall its package"


def test_kind_has_the_name_of_its_entry_point(install: Install) -> None:
    install(copy="fieldkit.steps.kinds.ping:PingStep")
    ping = {"from": "sender", "to": "receiver"}
    (entry,) = TypeAdapter(tuple[StepEntry, ...]).validate_python([{"copy": ping}])
    assert (entry.kind, type(entry.step)) == ("copy", PingStep)


def test_error_of_unknown_kind_mentions_packages(install: Install) -> None:
    install()
    with pytest.raises(ValidationError, match=r"unknown key zoom; .* need a package that is not installed"):
        TypeAdapter(tuple[StepEntry, ...]).validate_python([{"zoom": {}}])


def test_versions_include_packages_that_add_kinds(install: Install) -> None:
    install(copy="fieldkit.steps.kinds.ping:PingStep")
    assert plugins.versions() == {"fieldkit": version("fieldkit"), "more-steps": "1.0"}


def test_column_with_an_invalid_unit_is_to_be_corrected(
    install: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "declares_no_unit.py").write_text(
        "from fieldkit.core.columns import columns\nfrom fieldkit.steps.kinds.ping import PingStep\n"
        "class Load(PingStep):\n    columns = columns(100, ('load', '', 'Processes that ran.'))\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(tmp_path)
    install(load="declares_no_unit:Load")
    with pytest.raises(ConfigurationError, match="but its unit is not 1 to 20 printable characters") as caught:
        installed_columns()
    assert caught.value.remedy == "correct it there, or uninstall its package"
