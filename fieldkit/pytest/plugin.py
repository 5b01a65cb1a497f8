"""The plugin that pytest loads wherever fieldkit is installed: options, fixtures, the end of a test's evidence.

It imports nothing of fieldkit until a test asks for one of its fixtures: other tests pay for this module alone.
"""

from collections.abc import Generator, Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

import pytest

if TYPE_CHECKING:
    from fieldkit.pytest.evidence import EvidenceKeeper
    from fieldkit.pytest.lab import OpenedLab
    from fieldkit.pytest.options import LabOptions
    from fieldkit.pytest.robots import RobotHandles
    from fieldkit.pytest.trials import TrialRunner

_FIXTURES: Final = frozenset({"lab", "robots", "trial"})
_KEEPER: Final = pytest.StashKey[Any]()  # the `EvidenceKeeper`
_STAMP: Final = pytest.StashKey[str]()
_RUN: Final = "fieldkit_run"

_OPTIONS: Final[dict[str, tuple[str, str, tuple[str, ...] | None]]] = {
    "backend": ("NAME", "where robots come from, emulated or field; else as the site file says", None),
    "site": ("FILE", "the lab's site file; else fieldkit.yaml where pytest was started, if there is one", None),
    "topology": ("NAME", "whose robots are brought up; else the first of the site file", ("master", "masterless")),
    "output": ("DIR", "folder for evidence; else fieldkit-results in pytest's root folder", None),
    "keep": ("WHICH", "whose evidence is kept; else that of failed tests", ("failed", "all", "none")),
}


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options, each also as a key of pytest's configuration: `fieldkit_backend`."""
    group = parser.getgroup("fieldkit", "fieldkit: tests on emulated or real robots")
    for name, (metavar, text, choices) in _OPTIONS.items():
        group.addoption(f"--fieldkit-{name}", metavar=metavar, choices=choices, help=text)
        parser.addini(f"fieldkit_{name}", text)
    group.addoption(
        "--fieldkit-yes", action="store_true", help="ask nobody: real robots stand where the tests want them"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Refuse what the configuration says wrong, as the command line does by itself."""
    for name, (_, _, choices) in _OPTIONS.items():
        written = config.getini(f"fieldkit_{name}")
        if choices and written and written not in choices:
            raise pytest.UsageError(f"fieldkit_{name} = {written}: choose from {', '.join(choices)}")


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:  # noqa: ANN401 (xdist tells no type)
    """Let all workers of pytest-xdist put their evidence into the same folder."""
    node.workerinput[_RUN] = _run(node.config)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Begin the evidence of a test that asks for robots."""
    if not _FIXTURES.isdisjoint(getattr(item, "fixturenames", ())):
        _keeper(item.config).begin(item)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> None:
    """Tell what the test itself does from what was set up for it, and perhaps for others."""
    if keeper := item.config.stash.get(_KEEPER, None):
        keeper.call(item)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Name the evidence of a test that failed, and remove that of one that did not."""
    report = yield
    if keeper := item.config.stash.get(_KEEPER, None):
        keeper.judge(item, call, report)
    return report


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Settle the evidence of the last file of tests."""
    if keeper := session.config.stash.get(_KEEPER, None):
        keeper.end()


def _run(config: pytest.Config) -> str:
    """Return the name of this run's folder, the same in all workers."""
    if _STAMP not in config.stash:
        now = f"{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}"
        config.stash[_STAMP] = getattr(config, "workerinput", {}).get(_RUN, now)
    return config.stash[_STAMP]


def _keeper(config: pytest.Config) -> "EvidenceKeeper":
    from fieldkit.pytest.evidence import EvidenceKeeper  # noqa: PLC0415 (see above; so in all of these)
    from fieldkit.pytest.options import keep, output  # noqa: PLC0415

    if _KEEPER not in config.stash:
        config.stash[_KEEPER] = EvidenceKeeper(output(config) / _run(config), keep(config))
    keeper: EvidenceKeeper = config.stash[_KEEPER]
    return keeper


@pytest.fixture(scope="module")
def lab_options(pytestconfig: pytest.Config) -> "LabOptions":
    """What the lab is to be; define a fixture of this name to change it for a file of tests."""
    from fieldkit.pytest.options import of  # noqa: PLC0415

    return of(pytestconfig)


@pytest.fixture(scope="module")
def _fieldkit_lab(request: pytest.FixtureRequest, lab_options: "LabOptions") -> "Iterator[OpenedLab]":
    """The lab of a file of tests, whose robots are brought up when they are first asked for."""
    from fieldkit.pytest.lab import OpenedLab  # noqa: PLC0415
    from fieldkit.pytest.operator import operator_of  # noqa: PLC0415

    keeper = _keeper(request.config)
    workers = getattr(request.config, "workerinput", {}).get("workercount", 1)
    with OpenedLab(
        lab_options, keeper, operator_of(request.config, lab_options, keeper.told), workers=workers
    ) as lab:
        yield lab


@pytest.fixture(scope="module")
def lab(_fieldkit_lab: "OpenedLab") -> "OpenedLab":
    """The lab with its robots up: places them, takes links away, lets robots move."""
    _fieldkit_lab.open()
    return _fieldkit_lab


@pytest.fixture(scope="module")
def robots(lab: "OpenedLab") -> "RobotHandles":
    """The robots by role and by name: run programs on them, copy files, ask for addresses."""
    return lab.robots


@pytest.fixture(scope="module")
def trial(_fieldkit_lab: "OpenedLab") -> "TrialRunner":
    """Run a whole trial as `fieldkit trial` does: `trial("los", "30ft", repeats=2)`."""
    from fieldkit.pytest.trials import TrialRunner  # noqa: PLC0415

    return TrialRunner(_fieldkit_lab)
