"""Kinds of step: fieldkit's own, those of entry points, and entry points that cannot be used."""

from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path

import pytest
from pydantic import TypeAdapter, ValidationError

from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError
from fieldkit.steps.base import StepEntry, step_types
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.trial.columns import installed
from tests.helpers.outside_packages import write_package

OWN = ["record", "capture", "transfer", "ping", "fault", "move", "wait", "ask", "together"]
OWN += ["run", "iperf3", "soak", "send", "track", "topics", "mavlink", "fly"]

Install = Callable[..., None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Install a package with entry points: names and what they point to."""

    def entries(**targets: str) -> None:
        points = "".join(f"{name} = {target}\n" for name, target in targets.items())
        write_package(tmp_path / "installed", "more-steps", f"[{plugins.STEPS}]\n{points}")
        monkeypatch.syspath_prepend(tmp_path / "installed")

    cached = (step_types, installed)
    for one in cached:
        one.cache_clear()
    yield entries
    for one in cached:
        one.cache_clear()


def test_own_kinds_come_in_their_order_each_by_the_module_of_its_name(install: Install) -> None:
    install()
    assert list(step_types()) == OWN
    for kind, step in step_types().items():
        assert (step.__module__, step.__name__) == (f"fieldkit.steps.kinds.{kind}", f"{kind.capitalize()}Step")


def test_others_follow_by_name(install: Install) -> None:
    install(zoom="fieldkit.steps.kinds.ping:PingStep", load="fieldkit.steps.kinds.ping:PingStep")
    assert list(step_types()) == [*OWN, "load", "zoom"]
    assert step_types()["load"] is PingStep


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("no_such_package.steps:Load", "No module named 'no_such_package'"),
        ("fieldkit.steps.kinds.ping:NoSuchStep", "has no attribute 'NoSuchStep'"),
        ("half_written:Load", "SyntaxError: '\\(' was never closed"),
        ("unmet:Load", "ZeroDivisionError"),
    ],
)
def test_what_cannot_be_loaded_names_its_entry_point(
    install: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, target: str, said: str
) -> None:
    (tmp_path / "half_written.py").write_text("class Load(", encoding="utf-8")
    (tmp_path / "unmet.py").write_text("1 / 0", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    install(load=target)
    with pytest.raises(ConfigurationError, match=said) as caught:
        step_types()
    assert caught.value.what.startswith("it cannot be loaded: ")
    assert caught.value.where == f"entry point load = {target}"
    assert caught.value.remedy == "fix or uninstall its package"


@pytest.mark.parametrize("target", ["os.path:join", "fieldkit.steps.base:View", "fieldkit.steps.kinds.ping"])
def test_what_is_no_step_is_refused(install: Install, target: str) -> None:
    install(load=target)
    with pytest.raises(ConfigurationError, match="a kind of step is a subclass of Step") as caught:
        step_types()
    assert caught.value.where == f"entry point load = {target}"


def test_a_kind_of_fieldkits_own_is_not_replaced(install: Install) -> None:
    install(ping="no_such_package.steps:Ping")
    with pytest.raises(ConfigurationError, match="there is a kind of step 'ping' already") as caught:
        step_types()
    assert caught.value.where == "entry point ping = no_such_package.steps:Ping"


def test_what_lacks_a_part_of_the_contract_is_refused(install: Install) -> None:
    install(load="fieldkit.steps.program:ProgramStep")
    with pytest.raises(ConfigurationError, match="the kind of step lacks argv, parse"):
        step_types()


@pytest.mark.parametrize("name", ["rtt_sent", "status"])
def test_a_column_that_stands_for_something_else_is_refused(
    install: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / f"declares_{name}.py").write_text(
        "from fieldkit.core.columns import columns\nfrom fieldkit.steps.kinds.ping import PingStep\n"
        f"class Load(PingStep):\n    columns = columns(100, ('{name}', 'processes', 'Processes that ran.'))\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(tmp_path)
    install(load=f"declares_{name}:Load")
    with pytest.raises(ConfigurationError, match=f"'load' declares a column '{name}', which is another's") as caught:
        installed()
    assert caught.value.remedy == "rename it there, or uninstall its package"


def test_a_kind_may_have_any_name(install: Install) -> None:
    install(copy="fieldkit.steps.kinds.ping:PingStep")
    ping = {"from": "sender", "to": "receiver"}
    (entry,) = TypeAdapter(tuple[StepEntry, ...]).validate_python([{"copy": ping}])
    assert (entry.kind, type(entry.step)) == ("copy", PingStep)


def test_a_kind_that_is_not_installed_asks_for_its_package(install: Install) -> None:
    install()
    with pytest.raises(ValidationError, match=r"unknown key zoom; .* need a package that is not installed"):
        TypeAdapter(tuple[StepEntry, ...]).validate_python([{"zoom": {}}])


def test_packages_that_add_kinds_are_written_down(install: Install) -> None:
    install(copy="fieldkit.steps.kinds.ping:PingStep")
    assert plugins.versions() == {"fieldkit": version("fieldkit"), "more-steps": "1.0"}
