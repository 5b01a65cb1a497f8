"""Kinds of step: fieldkit's own, those of entry points, and entry points that cannot be used."""

from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint

import pytest

from fieldkit.core.errors import ConfigurationError
from fieldkit.steps import kinds
from fieldkit.steps.ping import PingStep

OWN = ["record", "capture", "transfer", "ping", "fault", "move"]

Install = Callable[..., None]


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Replace the entry points of this machine by others: names and what they point to."""

    def entries(**targets: str) -> None:
        points = [EntryPoint(name, target, kinds.ENTRY_POINTS) for name, target in targets.items()]

        def found(*, group: str) -> list[EntryPoint]:
            assert group == kinds.ENTRY_POINTS
            return points

        monkeypatch.setattr(kinds, "entry_points", found)

    kinds.known.cache_clear()
    yield entries
    kinds.known.cache_clear()


def test_own_kinds_come_in_their_order_each_by_the_module_of_its_name(install: Install) -> None:
    install()
    assert list(kinds.known()) == OWN
    for kind, step in kinds.known().items():
        assert (step.__module__, step.__name__) == (f"fieldkit.steps.{kind}", f"{kind.capitalize()}Step")


def test_others_follow_by_name(install: Install) -> None:
    install(zoom="fieldkit.steps.ping:PingStep", load="fieldkit.steps.ping:PingStep")
    assert list(kinds.known()) == [*OWN, "load", "zoom"]
    assert kinds.known()["load"] is PingStep


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("no_such_package.steps:Load", "No module named 'no_such_package'"),
        ("fieldkit.steps.ping:NoSuchStep", "has no attribute 'NoSuchStep'"),
    ],
)
def test_what_cannot_be_loaded_names_its_entry_point(install: Install, target: str, said: str) -> None:
    install(load=target)
    with pytest.raises(ConfigurationError, match=said) as caught:
        kinds.known()
    assert caught.value.what.startswith("a kind of step cannot be loaded: ")
    assert caught.value.where == f"entry point load = {target}"
    assert caught.value.remedy == "mend or uninstall its package"


@pytest.mark.parametrize("target", ["os.path:join", "fieldkit.steps.base:View", "fieldkit.steps.ping"])
def test_what_is_no_step_is_refused(install: Install, target: str) -> None:
    install(load=target)
    with pytest.raises(ConfigurationError, match="a kind of step is a subclass of Step") as caught:
        kinds.known()
    assert caught.value.where == f"entry point load = {target}"


def test_a_kind_of_fieldkits_own_is_not_replaced(install: Install) -> None:
    install(ping="no_such_package.steps:Ping")
    with pytest.raises(ConfigurationError, match="there is a kind of step 'ping' already") as caught:
        kinds.known()
    assert caught.value.where == "entry point ping = no_such_package.steps:Ping"
