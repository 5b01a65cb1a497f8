"""Shared fixtures, and settings of all tests: examples have no time limit, and the order of test files."""

import gc
import signal
import sys
from collections.abc import Iterator
from typing import Final

import pytest
from hypothesis import HealthCheck, settings

from fieldkit.measure.positions import position_files
from tests.helpers.sshd import server

__all__ = ["server"]

pytest_plugins = ("pytester", "tests.helpers.leaks", "tests.helpers.priority", "tests.helpers.reruns")

# Tests that a shell starts in the background ignore SIGINT, and the programs that they start would also ignore it.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Any example may be slow on a busy machine. `make test` uses `ci`, which is the profile of hypothesis with fewer
# examples, which are the same in each run. `make nightly` uses `nightly`, with different examples in each run.
settings.register_profile("fieldkit", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", settings.get_profile("ci"), max_examples=25)
settings.register_profile("nightly", settings.get_profile("fieldkit"), print_blob=True)
settings.load_profile("fieldkit")

# Files that take long, the longest first, because a long file that starts late would run alone at the end. Files that
# run several trials in parallel (`known_loss`) are separated, so that they do not run at the same time.
_LONG: Final = (
    "test_docs",
    "test_drive",
    "test_smallest_emulated",
    "test_virtual_machine",
    "test_gazebo_federate",
    "test_step_conformance",
    "test_known_loss_tcp",
    "test_from_wheel",
    "test_drive_campaign",
    "test_step_topics",
    "test_cosim_shootout",
    "test_cosim_run",
    "test_trial_cosimulated",
    "test_convoy_on_ros",
    "test_step_fly_ends",
    "test_lab_command",
    "test_borders",
    "test_fly",
    "test_trial_emulated",
    "test_remote_jobs",
    "test_step_from_outside",
    "test_trial_resumed",
    "test_strangers_procedures",
    "test_ordinary_user",
    "test_fuzz",
    "test_selfheal",
    "test_remote_persistent_shells",
    "test_master_loss",
    "test_load_steps",
    "test_cli_varied",
    "test_check_emulated",
    "test_conformance",
    "test_full_disk",
    "test_agent",
    "test_robot_states",
    "test_trial_field",
    "test_ns3_network",
    "test_medium_process",
    "test_tool_variants",
    "test_changed_evidence",
    "test_emulated_lab",
    "test_smallest_benchmarks",
    "test_known_loss_udp",
    "test_bridge",
    "test_any_procedure",
    "test_power_cuts",
    "test_chaos",
    "test_rosbag_behaviour",
    "test_campaign_emulated",
    "test_trial_crash",
    "test_trial_locks",
    "test_hanging_tools",
    "test_fly_repeats",
    "test_report_page",
    "test_pytest_fixtures",
    "test_control_radio",
    "test_crossing_transfers",
    "test_middleware_sizes",
    "test_sweep_killed",
    "test_measure_links",
    "test_ros2_on_air",
    "test_measure_stream",
    "test_testbed_lost",
    "test_remote_large",
    "test_remote_telemetry",
    "test_ros2_bag",
    "test_redeclared_columns",
    "test_flight_ends",
    "test_strict_runs",
    "test_unchanged_proof",
    "test_bridges",
    "test_remote_ssh",
    "test_radio_off",
    "test_stored_trials",
    "test_driveaway",
    "test_ground_stations",
    "test_link_server",
    "test_bad_robots",
    "test_mavlink_agent",
    "test_control_outage",
    "test_rescue_program",
    "test_known_dead",
    "test_halting",
)


_READERS: Final = (
    ("fieldkit.motion.logs.tlog", "_READER"),
    ("fieldkit.ros.bags.bag", "_READER"),
    ("fieldkit.ros.bags.contents", "_WORKER"),
)
"""The readers of modules that a copy of the repository may not have."""


@pytest.fixture(scope="session", autouse=True)
def _stop_readers() -> Iterator[None]:
    """Stop the file readers: each would wait a minute for a further file, and the process check would wait for it."""
    yield
    position_files._GPX_READER.stop()
    for name, reader in _READERS:
        if module := sys.modules.get(name):
            getattr(module, reader).stop()


# Objects that the collection creates live until the end of the run, so the garbage collector must not scan them.
gc.disable()


def pytest_collection_finish() -> None:
    """Restrict garbage collection to objects that tests create."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Move long files to the front. Afterwards, `tests.helpers.priority` distributes those with real programs."""
    items.sort(key=lambda item: _LONG.index(item.path.stem) if item.path.stem in _LONG else len(_LONG))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the property `result` of passing tests, for use in issues."""
    for report in terminalreporter.stats.get("passed", []):
        for name, text in report.user_properties:
            if name == "result":
                terminalreporter.write_line(text)
