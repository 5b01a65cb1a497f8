"""Trials of the field backend on robots that outlive fieldkit."""

from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role, Topology
from fieldkit.remote import jobs
from sim_backends.emulated.backend import DEFAULT_SITE
from tests.helpers.field_robots import FieldRobots, start_field_robots
from tests.helpers.host import wait_for_end
from tests.helpers.nightly import mark_nightly
from tests.helpers.runs import only_trial, rows, run_here, start, wait_for_line

pytestmark = pytest.mark.emulated

SHORT_TRIAL = ("--repeats", "1", "--record", "1s", "--yes", "--backend", "field")


@pytest.mark.parametrize("topology", mark_nightly(Topology, in_ci=(Topology.MASTER,)))
def test_a_trial_of_the_field_backend_is_valid(tmp_path: Path, topology: Topology) -> None:
    with start_field_robots(tmp_path, topology=topology, site=DEFAULT_SITE) as field_robots:
        run = run_here(tmp_path, "trial", "los", "5m", "--topology", topology, *SHORT_TRIAL)
        assert run.code == 0, run.err
        table = rows(only_trial(tmp_path))
        assert [(row["protocol"], row["status"]) for row in table] == [("tcp", "valid"), ("udp", "valid")]
        assert {row["receiver"] for row in table} == {field_robots.cast[Role.RECEIVER].name}


def test_robots_and_their_jobs_outlive_a_fieldkit_that_is_killed(tmp_path: Path) -> None:
    with start_field_robots(tmp_path) as field_robots:
        process = start(
            tmp_path, "trial", "los", "5m", "--topology", "masterless", "--record", "30s", "--yes", "--json"
        )
        wait_for_line(process, '"record"')
        recording_jobs = wait_until_recording(field_robots)
        process.kill()
        process.communicate(timeout=60)
        wait_for_end({process.pid}, within_s=60.0)
        assert running_jobs_of(field_robots, Role.SENDER) == recording_jobs


def wait_until_recording(field_robots: FieldRobots) -> tuple[str, ...]:
    """Wait until the recorder is a running job; return the running jobs. The steps before it have jobs, too."""
    deadline = Deadline.after(60)
    while "/record " not in " ".join(running_jobs := running_jobs_of(field_robots, Role.SENDER)):
        assert not deadline.expired, "the recording did not start"
    return running_jobs


def running_jobs_of(field_robots: FieldRobots, role: Role) -> tuple[str, ...]:
    return jobs.list_running(field_robots.testbed.shells[role], Deadline.after(30))
