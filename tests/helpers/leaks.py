"""A pytest plugin that makes the run fail if processes of tests remain, even if all tests pass.

The process watch is deliberately not a fixture. The teardown of a fixture belongs to the last test and is repeated
with it, and in the repetition the leaked process would count as one that existed before.
"""

import ctypes
import os
import signal
import time
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Final

import pytest

from tests.helpers.host import LeakError, NamespaceComparison, descendants, is_running, separate_namespaces

_PR_SET_CHILD_SUBREAPER: Final = 36  # linux/prctl.h: orphans become children of this process, not of init
_KEY: Final = "processes left behind"


class _ProcessWatch:
    """Records the descendants of this process, and the test file after which each was first observed.

    Attributes:
        leaks: One line per remaining process, from all workers.
    """

    def __init__(self, config: pytest.Config) -> None:
        assert ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) == 0
        self.leaks: list[str] = []
        self._config = config
        self._before = descendants(os.getpid())
        self._seen_after: dict[int, str] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_teardown(self, item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
        """Record the running processes after the last test of a file."""
        try:
            yield
        finally:
            if nextitem is None or nextitem.path != item.path:
                for pid in descendants(os.getpid()):
                    self._seen_after.setdefault(pid, item.path.name)

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Wait until all processes exit, and kill and report the others; fixtures are already torn down."""
        if self._config.getoption("dist", "no") == "no":
            self._end_processes()
        if hasattr(self._config, "workeroutput"):
            self._config.workeroutput[_KEY] = self.leaks
        elif self.leaks and session.exitstatus in {pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED}:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def _end_processes(self) -> None:
        deadline_s = time.monotonic() + self._config.getoption("--end-within")
        # The tracker process of multiprocessing runs as long as the process that started it.
        resource_tracker._resource_tracker._stop()  # type: ignore[attr-defined]
        while remaining := self._running():
            if time.monotonic() >= deadline_s:
                break
            time.sleep(0.05)
        for pid in remaining:
            self.leaks.append(f"{_command(pid)}(seen after {self._seen_after.get(pid, 'all tests')})")
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _running(self) -> list[int]:
        """PIDs of the running processes, after reaping those that have exited.

        This process adopts orphans, so it must also reap them: the first process of a PID namespace cannot exit
        before its last zombie is reaped, including one that `nsenter` started from outside.
        """
        pids = descendants(os.getpid()) - self._before
        for pid in pids:
            with suppress(ChildProcessError):
                os.waitpid(pid, os.WNOHANG)
        return [pid for pid in pids if is_running(pid)]

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:  # noqa: ANN401 (xdist has no type hints)
        """Collect the leaks of a worker; a crashed worker reports nothing, and the crash already fails the run."""
        self.leaks += getattr(node, "workeroutput", {}).get(_KEY, [])

    @pytest.hookimpl(trylast=True)
    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """List the remaining processes after all other sections, where they are most visible."""
        if self.leaks:
            terminalreporter.section(_KEY, red=True)
            for leak in self.leaks:
                terminalreporter.write_line(leak)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option for the time limit."""
    parser.addoption(
        "--end-within",
        type=float,
        default=60.0,
        metavar="SECONDS",
        help="time after which processes of tests that still run are an error",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Register the process watch."""
    config.pluginmanager.register(_ProcessWatch(config))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Iterator[None]:
    """Check that Ctrl-C still has its effect after a test; otherwise later tests of interrupts would fail.

    Raises:
        LeakError: A test has changed the handling of SIGINT in this process, or has blocked it.
    """
    yield
    handler, is_blocked = (
        signal.getsignal(signal.SIGINT),
        signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()),
    )
    if handler is not signal.default_int_handler or is_blocked:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT,))
        raise LeakError(f"{item.nodeid} changed SIGINT: handler {handler}, blocked: {is_blocked}")


@pytest.fixture
def untouched() -> Iterator[NamespaceComparison]:
    """Run the test in separate network and mount namespaces.

    The yielded function checks that they are unchanged; it is also called at the end.
    """
    with separate_namespaces():
        check = NamespaceComparison()
        yield check
        check()


def _command(pid: int) -> str:
    """Command line of a process; if it has none, for example while it exits, its name in brackets."""
    folder = Path(f"/proc/{pid}")
    try:
        command = (folder / "cmdline").read_text(encoding="utf-8", errors="replace").replace("\0", " ")
        return command or f"[{(folder / 'comm').read_text(encoding='utf-8', errors='replace').strip()}, pid {pid}] "
    except OSError:
        return ""
