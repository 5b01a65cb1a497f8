"""Fixtures that several folders share, and what holds for all tests: no time limit on an example, long ones first."""

import gc
import signal
from collections.abc import Iterator
from typing import Final

import pytest
from hypothesis import HealthCheck, settings

from fieldkit.bags import contents
from fieldkit.measure.evidence import bag
from fieldkit.measure.motion import tlog
from fieldkit.measure.positions import position_files
from tests.helpers.sshd import server

__all__ = ["server"]

pytest_plugins = ("pytester", "tests.helpers.leaks", "tests.helpers.reruns")

# Tests that a shell started in the background ignore SIGINT, and so would every program that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# A busy machine makes any example slow. `make test` adds `--hypothesis-profile ci`, the same examples each time.
settings.register_profile("fieldkit", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("fieldkit")

# Files that take long, the longest first: one that begins late is waited for alone. Three of them run several trials
# at once and stand apart, so that they do not compete.
_LONG: Final = (
    "test_known_loss_tcp",
    "test_chaos",
    "test_tool_variants",
    "test_hanging_tools",
    "test_fly_repeats",
    "test_trial_resumed",
    "test_trial_emulated",
    "test_docs",
    "test_smallest_emulated",
    "test_known_loss_udp",
    "test_selfheal",
    "test_master_loss",
    "test_fly",
    "test_step_conformance",
    "test_driveaway",
    "test_drive",
    "test_bridges",
    "test_ros2_on_air",
    "test_ground_stations",
    "test_power_cuts",
    "test_campaign_emulated",
    "test_ordinary_user",
    "test_control_radio",
    "test_control_outage",
    "test_load_steps",
    "test_known_dead",
    "test_rosbag_behaviour",
    "test_check_emulated",
    "test_conformance",
    "test_cosim_run",
    "test_cosim_shootout",
    "test_emulated_lab",
    "test_pytest_fixtures",
    "test_pytest_from_wheel",
    "test_bad_robots",
    "test_lab_command",
    "test_report_page",
    "test_trial_crash",
)


@pytest.fixture(scope="session", autouse=True)
def _no_reader_waits() -> Iterator[None]:
    """End the readers of files: each would wait a minute for another one, and the watch on processes for it."""
    yield
    bag._READER.stop()
    contents._WORKER.stop()
    position_files._GPX_READER.stop()
    tlog._READER.stop()


# What collecting makes lives to the end of the run: nobody is to look through it, then or later.
gc.disable()


def pytest_collection_finish() -> None:
    """Look for garbage among what tests make alone."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put long files first and let the others keep their order."""
    items.sort(key=lambda item: _LONG.index(item.path.stem) if item.path.stem in _LONG else len(_LONG))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print what passing tests recorded under `said`: figures an issue wants to see."""
    for report in terminalreporter.stats.get("passed", []):
        for name, text in report.user_properties:
            if name == "said":
                terminalreporter.write_line(text)
