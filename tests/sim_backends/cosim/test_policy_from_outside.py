"""Sync policies of another package: the example of docs/cosim-api.md, loaded by its entry point, and faulty ones."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.federates import FederateError
from sim_backends.cosim.policies import registry
from tests.helpers.outside_packages import write_package
from tests.helpers.paths import ROOT

MS = 1_000_000

Install = Callable[[str, str, str], None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Return a function that installs a module with a policy and the package's entry point."""

    def write(source: str, name: str, target: str) -> None:
        write_package(tmp_path, "contact-policy", f"[{plugins.POLICIES}]\n{name} = {target}\n")
        (tmp_path / f"{target.partition(':')[0]}.py").write_text(source, encoding="utf-8")
        registry.policies.cache_clear()

    monkeypatch.syspath_prepend(tmp_path)
    yield write
    registry.policies.cache_clear()


def documented_example() -> tuple[str, str, str]:
    page = (ROOT / "docs" / "cosim-api.md").read_text(encoding="utf-8")
    (source,) = (
        block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "class TimeToContact" in block
    )
    (entry,) = re.findall(r'^    \[project\.entry-points\."(.*)"\]\n    (\w+) = "(.*)"$', page, re.MULTILINE)
    assert entry[0] == plugins.POLICIES
    return source, entry[1], entry[2]


def test_the_documented_policy_runs_by_its_name_with_the_parameters_that_it_has(install: Install) -> None:
    source, name, target = documented_example()
    install(source, name, target)
    assert list(registry.policies())[-1] == name
    scenario = load_scenario("convoy", {"policy": {"name": name, "window": "5ms", "longest": "20ms"}})
    run = build(scenario).run(150 * MS)
    lengths_ns = np.diff([0, *run.windows_ns])[:-1]  # the last window ends with the run
    assert 5 * MS <= min(lengths_ns) < 20 * MS == max(lengths_ns)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("class Lazy:\n    name = 'lazy'\n", "the sync policy lacks exact, defers_sends"),
        ("from sim_backends.cosim.policies.window_policies import EventDriven as Lazy\n", "must be 'lazy'"),
        ("1 / 0\n", "it cannot be loaded: ZeroDivisionError"),
    ],
)
def test_a_policy_that_cannot_be_used_is_refused_with_its_package(
    install: Install, source: str, message: str
) -> None:
    module = f"lazy_{len(message)}"
    install(source, "lazy", f"{module}:Lazy")
    with pytest.raises(ConfigurationError, match=message) as error_info:
        registry.make_policy("lazy")
    assert registry.make_policy("scheduled").name == "scheduled"
    assert error_info.value.where == f"entry point lazy = {module}:Lazy of contact-policy 1.0"


def test_a_policy_cannot_replace_a_built_in_one(install: Install) -> None:
    install("", "scheduled", "lazy_again:Lazy")
    with pytest.raises(ConfigurationError, match="there is already a sync policy 'scheduled'"):
        registry.policies()


def test_errors_in_the_code_of_a_policy_name_the_policy(install: Install) -> None:
    source, name, target = documented_example()
    install(source.replace("window_s=0.001,", "window,"), name, target.replace("contact", "contact_argument"))
    with pytest.raises(ConfigurationError, match=f"the sync policy '{name}' cannot be created: TypeError"):
        registry.make_policy(name)


def test_a_window_end_that_is_not_a_whole_number_is_an_error(install: Install) -> None:
    source, name, target = documented_example()
    install(
        source.replace("return situation", "return 0.5 + situation"), name, target.replace("contact", "contact_end")
    )
    with pytest.raises(FederateError, match=f"policy {name} returned [0-9.]+ as the end of the window"):
        build(load_scenario("convoy"), policy=name).run(10 * MS)
