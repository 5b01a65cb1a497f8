"""A pytest plugin that repeats failed tests of real programs once, to show whether the failure is random.

A run with a second try fails even if it succeeds, because the cause of a random failure must be found, too.
"""

from collections.abc import Generator
from typing import Final

import pytest

from tests.helpers.host import LeakError

_FAILED: Final = pytest.StashKey[bool]()


class _SecondTries:
    """Collects second tries in the process that receives all reports.

    Attributes:
        tests: The tests that had a second try, in order.
    """

    def __init__(self) -> None:
        self.tests: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Store a test with a failed first try once, even if both the test and its teardown failed."""
        if str(report.outcome) == "rerun" and report.nodeid not in self.tests:
            self.tests.append(report.nodeid)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Fail the run if a test had a second try."""
        if self.tests and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    @pytest.hookimpl(trylast=True)
    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Show why tests ran twice, and list them."""
        for report in terminalreporter.stats.get("rerun", []):
            terminalreporter.section(f"first try of {report.nodeid}")
            terminalreporter.write_line(report.longreprtext)
        if self.tests:
            terminalreporter.section("tests that ran twice; none may", red=True)
            for test in self.tests:
                terminalreporter.write_line(test)


def pytest_configure(config: pytest.Config) -> None:
    """Register the collector, but not in an xdist worker, whose reports are sent to the controller."""
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(_SecondTries())


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
    """Give tests of real programs and of timing a second try, except after a `LeakError`."""
    for item in items:
        if item.get_closest_marker("emulated") or item.get_closest_marker("quiet"):
            item.add_marker(pytest.mark.flaky(reruns=1, rerun_except=LeakError.__name__))
