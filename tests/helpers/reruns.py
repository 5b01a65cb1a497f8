"""A pytest plugin that repeats failed tests of real programs once, and fails a run that has too many repetitions."""

from collections.abc import Generator
from pathlib import Path
from typing import Final

import pytest

from tests.helpers.host import LeakError

ALLOWED: Final = 1
"""Number of second tries that a run may have."""

_FAILED: Final = pytest.StashKey[bool]()


class _Count:
    """Counts second tries in the process that collects all reports.

    Attributes:
        tries: The tests that had a second try, in order, starting with those of earlier parts of the run.
    """

    def __init__(self, log: Path | None) -> None:
        self.tries = log.read_text(encoding="utf-8").splitlines() if log is not None and log.exists() else []
        self._log = log

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count a failed first try once, even if both the test and its teardown failed."""
        if str(report.outcome) == "rerun" and report.nodeid not in self.tries:
            self.tries.append(report.nodeid)
            if self._log is not None:
                self._log.write_text("".join(f"{test}\n" for test in self.tries), encoding="utf-8")

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Fail the run if there were too many second tries."""
        if len(self.tries) > ALLOWED and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    @pytest.hookimpl(trylast=True)
    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Show why tests ran twice, and list them if they are too many."""
        for report in terminalreporter.stats.get("rerun", []):
            terminalreporter.section(f"first try of {report.nodeid}")
            terminalreporter.write_line(report.longreprtext)
        if len(self.tries) > ALLOWED:
            terminalreporter.section(f"{len(self.tries)} tests ran twice; the limit is {ALLOWED}", red=True)
            for test in self.tries:
                terminalreporter.write_line(test)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option for the file that counts second tries over all parts of a run."""
    parser.addoption(
        "--rerun-log",
        type=Path,
        metavar="FILE",
        help="tests that ran twice, one per line; existing lines count as well",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Register the counter, but not in an xdist worker, whose reports are sent to the controller."""
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Count(config.getoption("--rerun-log")))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Store the result of the test before its fixtures are torn down."""
    report = yield
    if report.when != "teardown":
        item.stash[_FAILED] = report.failed
    return report


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Tear down the module fixtures of a failed test, so that its second try uses a new lab."""
    if item.stash.get(_FAILED, False):
        item.session._setupstate.teardown_exact(item.session)  # type: ignore[arg-type]  # a session is a node too


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Allow a second try of tests of real programs and of timing, except after a `LeakError`."""
    for item in items:
        if item.get_closest_marker("emulated") or item.get_closest_marker("quiet"):
            item.add_marker(pytest.mark.flaky(reruns=1, rerun_except=LeakError.__name__))
