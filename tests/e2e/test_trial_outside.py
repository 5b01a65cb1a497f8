"""Trials of the field backend on robots that outlive fieldkit."""

from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role, Topology
from fieldkit.remote import jobs
from sim_backends.emulated.backend import DEFAULT_SITE
from tests.helpers.host import wait_for_end
from tests.helpers.outside import Outside, robots_outside
from tests.helpers.runs import only_trial, rows, run_here, start, wait_for_line

pytestmark = pytest.mark.emulated

QUICK = ("--repeats", "1", "--record", "1s", "--yes", "--backend", "field")


@pytest.mark.parametrize("topology", Topology)
def test_a_trial_of_the_field_backend_ends_valid(tmp_path: Path, topology: Topology) -> None:
    with robots_outside(tmp_path, topology=topology, site=DEFAULT_SITE) as outside:
        run = run_here(tmp_path, "trial", "los", "5m", "--topology", topology, *QUICK)
        assert run.code == 0, run.err
        table = rows(only_trial(tmp_path))
        assert [(row["protocol"], row["status"]) for row in table] == [("tcp", "valid"), ("udp", "valid")]
        assert {row["receiver"] for row in table} == {outside.cast[Role.RECEIVER].name}


def test_robots_and_their_jobs_outlive_a_fieldkit_that_is_killed(tmp_path: Path) -> None:
    with robots_outside(tmp_path) as outside:
        process = start(
            tmp_path, "trial", "los", "5m", "--topology", "masterless", "--record", "30s", "--yes", "--json"
        )
        wait_for_line(process, '"record"')
        recording = wait_until_recording(outside)
        process.kill()
        process.communicate(timeout=60)
        wait_for_end({process.pid}, within_s=60.0)
        assert jobs_left(outside, Role.SENDER) == recording


def wait_until_recording(outside: Outside) -> tuple[str, ...]:
    deadline = Deadline.after(60)
    while not (running_jobs := jobs_left(outside, Role.SENDER)):
        assert not deadline.expired, "it never began to record"
    return running_jobs


def jobs_left(outside: Outside, role: Role) -> tuple[str, ...]:
    return jobs.list_running(outside.testbed.shells[role], Deadline.after(30))
