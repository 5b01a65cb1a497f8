"""A pytest plugin: what tests leave behind fails the run, whatever the tests came to.

The watch on processes is no fixture on purpose. The end of a fixture is part of the last test and is repeated with
it: by then the leaked process is one of those that were there before.
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

from tests.helpers.host import Untouched, alive, descendants, namespaces_of_our_own

_PR_SET_CHILD_SUBREAPER: Final = 36  # linux/prctl.h: whoever loses its parent becomes a child of ours, not of init's
_KEY: Final = "processes left behind"


class _Watch:
    """Knows which processes descend from this one, and after which file of tests each was first seen.

    Attributes:
        leaks: A line per process that was left behind, of all workers.
    """

    def __init__(self, config: pytest.Config) -> None:
        assert ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) == 0
        self.leaks: list[str] = []
        self._config = config
        self._before = descendants(os.getpid())
        self._seen_after: dict[int, str] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_teardown(self, item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
        """Note after the last test of a file what runs now."""
        try:
            yield
        finally:
            if nextitem is None or nextitem.path != item.path:
                for pid in descendants(os.getpid()):
                    self._seen_after.setdefault(pid, item.path.name)

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Wait for all processes to end, end those that do not, and tell of them; fixtures have ended by now."""
        if self._config.getoption("dist", "no") == "no":
            self._look()
        if hasattr(self._config, "workeroutput"):
            self._config.workeroutput[_KEY] = self.leaks
        elif self.leaks and session.exitstatus in {pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED}:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def _look(self) -> None:
        ends = time.monotonic() + self._config.getoption("--end-within")
        # The tracker process of multiprocessing lives as long as the process that started it.
        resource_tracker._resource_tracker._stop()  # type: ignore[attr-defined]
        while left := self._running():
            if time.monotonic() >= ends:
                break
            time.sleep(0.05)
        for pid in left:
            self.leaks.append(f"{_command(pid)}(seen after {self._seen_after.get(pid, 'all tests')})")
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _running(self) -> list[int]:
        """Return the processes that run, after waiting for those that have ended.

        This process adopts orphans, so it must also wait for them: the first process of a PID namespace cannot end
        before its last zombie has been waited for, also one that `nsenter` started from outside.
        """
        started = descendants(os.getpid()) - self._before
        for pid in started:
            with suppress(ChildProcessError):
                os.waitpid(pid, os.WNOHANG)
        return [pid for pid in started if alive(pid)]

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:  # noqa: ANN401 (xdist tells no type)
        """Take over what a worker found; one that crashed has told nothing, and fails the run by itself."""
        self.leaks += getattr(node, "workeroutput", {}).get(_KEY, [])

    @pytest.hookimpl(trylast=True)
    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """List the processes that were left behind, after all other sections: the end of a log is what people see."""
        if self.leaks:
            terminalreporter.section(_KEY, red=True)
            for leak in self.leaks:
                terminalreporter.write_line(leak)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add how long to wait."""
    parser.addoption(
        "--end-within", type=float, default=60.0, metavar="SECONDS", help="until which all processes of tests ended"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Begin to watch."""
    config.pluginmanager.register(_Watch(config))


@pytest.fixture
def untouched() -> Iterator[Untouched]:
    """Run the test in network and mounts of its own, and see at its end, or when it asks, that they are as before."""
    with namespaces_of_our_own():
        check = Untouched()
        yield check
        check()


def _command(pid: int) -> str:
    """Return the command line of a process, or where it has none, as while it ends, its name in brackets."""
    folder = Path(f"/proc/{pid}")
    try:
        command = (folder / "cmdline").read_text(encoding="utf-8", errors="replace").replace("\0", " ")
        return command or f"[{(folder / 'comm').read_text(encoding='utf-8', errors='replace').strip()}, pid {pid}] "
    except OSError:
        return ""
