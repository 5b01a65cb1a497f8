"""A pytest plugin: real programs get a second try on a busy machine, and a run with many of those fails."""

from collections.abc import Generator
from pathlib import Path
from typing import Final

import pytest

from tests.helpers.host import LeakError

ALLOWED: Final = 3
"""Second tries that a run may have. The cause of each must be found: then none is allowed."""

_FAILED: Final = pytest.StashKey[bool]()


class _Count:
    """Counts second tries where all reports come together.

    Attributes:
        tries: The tests that had one, those of earlier parts of the run first.
    """

    def __init__(self, log: Path | None) -> None:
        self.tries = log.read_text(encoding="utf-8").splitlines() if log is not None and log.exists() else []
        self._log = log

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count a first try that failed, once, whether in its body, in what ends it, or in both."""
        if str(report.outcome) == "rerun" and report.nodeid not in self.tries:
            self.tries.append(report.nodeid)
            if self._log is not None:
                self._log.write_text("".join(f"{test}\n" for test in self.tries), encoding="utf-8")

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Fail the run if there were too many."""
        if len(self.tries) > ALLOWED and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    @pytest.hookimpl(trylast=True)
    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Show why tests ran twice, and that there were too many."""
        for report in terminalreporter.stats.get("rerun", []):
            terminalreporter.section(f"first try of {report.nodeid}")
            terminalreporter.write_line(report.longreprtext)
        if len(self.tries) > ALLOWED:
            terminalreporter.section(f"{len(self.tries)} tests ran twice, at most {ALLOWED} may", red=True)
            for test in self.tries:
                terminalreporter.write_line(test)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the file in which the parts of a run add up."""
    parser.addoption(
        "--rerun-log", type=Path, metavar="FILE", help="tests that ran twice, a line each: what is in it counts too"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Count, but not in a worker: its reports go on to where all come together."""
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Count(config.getoption("--rerun-log")))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Note what a try came to before its fixtures end."""
    report = yield
    if report.when != "teardown":
        item.stash[_FAILED] = report.failed
    return report


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """End the fixtures of the module of a test that failed: its next try gets a lab that no first try has touched."""
    if item.stash.get(_FAILED, False):
        item.session._setupstate.teardown_exact(item.session)  # type: ignore[arg-type]  # a session is a node with parents too


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give tests of real programs, or of times, a second try; what is left behind is left behind the first time."""
    for item in items:
        if item.get_closest_marker("emulated") or item.get_closest_marker("quiet"):
            item.add_marker(pytest.mark.flaky(reruns=1, rerun_except=LeakError.__name__))
