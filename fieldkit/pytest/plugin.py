"""The pytest plugin, loaded in every environment with fieldkit: options, fixtures, and clean-up of evidence.

It imports no other module of fieldkit until a test requests one of its fixtures, so that other tests start fast.
"""

from collections.abc import Generator, Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

import pytest

if TYPE_CHECKING:
    from fieldkit.pytest.evidence import EvidenceKeeper
    from fieldkit.pytest.lab_fixture import OpenedLab
    from fieldkit.pytest.plugin_options import LabOptions
    from fieldkit.pytest.robot_fixture import RobotHandles
    from fieldkit.pytest.trials import TrialRunner

_FIXTURES: Final = frozenset({"lab", "robots", "trial"})
_KEEPER: Final = pytest.StashKey[Any]()  # the `EvidenceKeeper`
_STAMP: Final = pytest.StashKey[str]()  # the name of the folder of this run, which is its start time
_RUN: Final = "fieldkit_run"  # key of this folder name in the input of a worker of pytest-xdist

OPTIONS: Final[dict[str, tuple[str, str, tuple[str, ...] | None]]] = {
    "backend": (
        "NAME",
        "backend of the robots: emulated, field or another; default: the backend of the site file",
        None,
    ),
    "site": ("FILE", "the lab's site file; default: fieldkit.yaml in the current folder, if there is one", None),
    "topology": (
        "NAME",
        "topology of the robots; default: the first of the site file, otherwise master; in a trial, its procedure's",
        ("master", "masterless"),
    ),
    "output": ("DIR", "folder for the evidence of all runs; default: fieldkit-results in pytest's root folder", None),
    "keep": ("WHICH", "tests whose evidence is kept; default: failed", ("failed", "all", "none")),
}
"""Options by name: placeholder, meaning, and the possible values if they are limited."""
YES: Final = "show no questions: real robots are already at their places"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options; each except `--fieldkit-yes` is also a key of pytest's configuration: `fieldkit_backend`."""
    group = parser.getgroup("fieldkit", "fieldkit: tests on emulated or real robots")
    for name, (metavar, text, choices) in OPTIONS.items():
        group.addoption(f"--fieldkit-{name}", metavar=metavar, choices=choices, help=text)
        parser.addini(f"fieldkit_{name}", text)
    group.addoption("--fieldkit-yes", action="store_true", help=YES)


def pytest_configure(config: pytest.Config) -> None:
    """Reject invalid values in the configuration file, as pytest does for the command line."""
    for name, (_, _, choices) in OPTIONS.items():
        configured = config.getini(f"fieldkit_{name}")
        if choices and configured and configured not in choices:
            raise pytest.UsageError(f"fieldkit_{name} = {configured}: choose from {', '.join(choices)}")


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:  # noqa: ANN401 (xdist declares no type)
    """Pass the name of the evidence folder to all workers of pytest-xdist, so that they use the same one."""
    node.workerinput[_RUN] = _run_name(node.config)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Start the evidence of a test that uses robots."""
    if not _FIXTURES.isdisjoint(getattr(item, "fixturenames", ())):
        _keeper(item.config).begin(item)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> None:
    """Separate the evidence of the test from the evidence of its set-up, which several tests may share."""
    if keeper := item.config.stash.get(_KEEPER, None):
        keeper.begin_test(item)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Report the evidence of a failed test, and remove the evidence of a test unless the option `keep` selects it."""
    report = yield
    if keeper := item.config.stash.get(_KEEPER, None):
        keeper.process_report(item, call, report)
    return report


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Clean up the evidence of the last test module."""
    if keeper := session.config.stash.get(_KEEPER, None):
        keeper.end()


def _run_name(config: pytest.Config) -> str:
    """Return the name of this run's folder, the same in all workers."""
    if _STAMP not in config.stash:
        now = f"{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}"
        config.stash[_STAMP] = getattr(config, "workerinput", {}).get(_RUN, now)
    return config.stash[_STAMP]


def _keeper(config: pytest.Config) -> "EvidenceKeeper":
    from fieldkit.pytest.evidence import EvidenceKeeper  # noqa: PLC0415 (see the module docstring; also below)
    from fieldkit.pytest.plugin_options import keep, output  # noqa: PLC0415

    if _KEEPER not in config.stash:
        config.stash[_KEEPER] = EvidenceKeeper(output(config) / _run_name(config), keep(config))
    keeper: EvidenceKeeper = config.stash[_KEEPER]
    return keeper


@pytest.fixture(scope="module")
def lab_options(pytestconfig: pytest.Config) -> "LabOptions":
    """Options of the lab; define a fixture of this name to change them for a test module."""
    from fieldkit.pytest.plugin_options import read_lab_options  # noqa: PLC0415

    return read_lab_options(pytestconfig)


@pytest.fixture(scope="module")
def _fieldkit_lab(request: pytest.FixtureRequest, lab_options: "LabOptions") -> "Iterator[OpenedLab]":
    """The lab of a test module; its robots are opened on first use."""
    from fieldkit.pytest.lab_fixture import OpenedLab, operator_of  # noqa: PLC0415

    keeper = _keeper(request.config)
    workers = getattr(request.config, "workerinput", {}).get("workercount", 1)
    with OpenedLab(
        lab_options, keeper, operator_of(request.config, lab_options, keeper.add_event), workers=workers
    ) as lab:
        yield lab


@pytest.fixture(scope="module")
def lab(_fieldkit_lab: "OpenedLab") -> "OpenedLab":
    """The lab with its robots open; it places robots, injects faults and moves robots."""
    _fieldkit_lab.open()
    return _fieldkit_lab


@pytest.fixture(scope="module")
def robots(lab: "OpenedLab") -> "RobotHandles":
    """The robots by role and by name; they run programs, copy files and have addresses."""
    return lab.robots


@pytest.fixture(scope="module")
def trial(_fieldkit_lab: "OpenedLab") -> "TrialRunner":
    """Run a whole trial as `fieldkit trial` does: `trial("los", "30ft", repeats=2)`."""
    from fieldkit.pytest.trials import TrialRunner  # noqa: PLC0415

    return TrialRunner(_fieldkit_lab)
