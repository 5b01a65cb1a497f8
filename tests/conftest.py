"""Fixtures that several folders share, and what holds for every test: no time limit on an example, nothing left."""

import ctypes
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from hypothesis import HealthCheck, settings

from fieldkit.core.deadline import Deadline
from tests.helpers.host import alive, descendants
from tests.helpers.sshd import server

__all__ = ["nothing_is_left", "server"]

# Tests that a shell started in the background ignore SIGINT, and so would every program that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# A busy machine makes any example slow. `make test` adds `--hypothesis-profile ci`, the same examples each time.
settings.register_profile("fieldkit", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("fieldkit")

_PR_SET_CHILD_SUBREAPER: Final = 36  # linux/prctl.h: whoever loses its parent becomes a child of ours, not of init's
_END_S: Final = 60.0  # for what is told to end when the last fixture ends


@pytest.fixture(scope="session", autouse=True)
def nothing_is_left() -> Iterator[None]:
    """See that no process outlives the tests that started it, whatever it did to detach itself."""
    assert ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) == 0
    before = descendants(os.getpid())
    yield
    deadline = Deadline.after(_END_S)
    while (left := [pid for pid in descendants(os.getpid()) - before if alive(pid)]) and not deadline.expired:
        time.sleep(0.05)
    assert [_command(pid) for pid in left] == [], "processes that tests left behind"


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8", errors="replace").replace("\0", " ")
    except OSError:
        return ""


# Files that take long, the longest first: one that begins late is waited for alone. Three of them run several trials
# at once and stand apart, so that they do not compete.
_LONG: Final = (
    "test_known_loss_tcp",
    "test_chaos",
    "test_tool_variants",
    "test_hanging_tools",
    "test_trial_resumed",
    "test_trial_emulated",
    "test_docs",
    "test_known_loss_udp",
    "test_selfheal",
    "test_driveaway",
    "test_campaign_emulated",
    "test_ordinary_user",
    "test_control_radio",
    "test_control_outage",
    "test_rosbag_behaviour",
    "test_check_emulated",
    "test_conformance",
    "test_emulated_lab",
    "test_bad_robots",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put long files first and let the others keep their order; give real programs on a busy machine a second try.

    The summary names each test that needed it (RERUN): it is to be looked into, and a second failure is a failure.
    """
    for item in items:
        if item.get_closest_marker("emulated") or item.get_closest_marker("quiet"):
            item.add_marker(pytest.mark.flaky(reruns=1))
    items.sort(key=lambda item: _LONG.index(item.path.stem) if item.path.stem in _LONG else len(_LONG))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print what passing tests recorded under `said` (figures an issue wants to see), and why others ran twice."""
    for report in terminalreporter.stats.get("passed", []):
        for name, text in report.user_properties:
            if name == "said":
                terminalreporter.write_line(text)
    for report in terminalreporter.stats.get("rerun", []):
        terminalreporter.section(f"first try of {report.nodeid}")
        terminalreporter.write_line(report.longreprtext)
