"""`fieldkit abort` on robots that outlive fieldkit; it stops their jobs even if another robot is unreachable."""

import re
from pathlib import Path

import pytest

from fieldkit.config.locations import SITE_FILE
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LockLostError
from fieldkit.core.model import Role
from fieldkit.remote import evidence, jobs
from fieldkit.remote.jobs import Job
from fieldkit.trial.running.locks import Holder, locked
from tests.helpers.field_robots import start_field_robots
from tests.helpers.runs import run_here
from tests.helpers.sshd import free_port, make_key

FOLDER = jobs.work_folder("trial-a", "tcp-01-1")
CAPTURE = Job(folder=FOLDER, name="capture", argv=("sleep", "99"), limit_s=99, log="log")
ANNA = Holder("trial-a", "anna@one", "trial-a")


@pytest.mark.emulated
def test_abort_stops_the_jobs_and_names_the_unreachable_robot(tmp_path: Path) -> None:
    with start_field_robots(tmp_path) as field_robots:
        shells = field_robots.testbed.shells
        sender, receiver = (field_robots.cast[role].name for role in (Role.SENDER, Role.RECEIVER))
        with locked(shells, ANNA, sink=print):
            for role in (Role.SENDER, Role.RECEIVER):
                evidence.begin(shells[role], FOLDER, role, "wlan0", token=ANNA.token)
                jobs.start(shells[role], CAPTURE)

            site = tmp_path / SITE_FILE
            complete_site = site.read_text(encoding="utf-8")
            port = field_robots.links.port(Role.RECEIVER)
            site.write_text(complete_site.replace(f"port: {port},", f"port: {free_port()},"), encoding="utf-8")
            run = run_here(tmp_path, "abort", "--yes")
            assert run.code == 3
            assert f"{sender}: lock removed, 1 job terminated\n  {FOLDER}/capture " in run.out
            assert re.search(rf"error: {receiver}: .* cannot be reached", run.err)
            assert jobs.list_running(shells[Role.SENDER], Deadline.after(30)) == ()
            assert len(jobs.list_running(shells[Role.RECEIVER], Deadline.after(30))) == 1

            site.write_text(complete_site, encoding="utf-8")
            run = run_here(tmp_path, "abort", "--yes")
            assert run.code == 0
            assert f"{sender}: not locked, 0 jobs terminated\n{receiver}: lock removed, 1 job terminated\n" in run.out
            with pytest.raises(LockLostError, match=r"the trial was aborted by \S+@\S+ at") as caught:
                evidence.begin(shells[Role.SENDER], FOLDER, Role.SENDER, "wlan0", token=ANNA.token)
            assert re.search(r"by \w+@", caught.value.what)


def test_abort_needs_a_confirmation(tmp_path: Path) -> None:
    key = " ".join(make_key(tmp_path / "key").split()[:2])
    robot = f"{{profile: duckiedrone, host: localhost, user: nobody, host_key: {key}}}"
    site = f"backend: field\nrobots:\n  a: {robot}\nroles: {{}}\n"
    (tmp_path / SITE_FILE).write_text(site, encoding="utf-8")
    run = run_here(tmp_path, "abort")
    assert run.code == 2
    assert "a person must confirm: terminate every job of fieldkit on a" in run.err
    assert "--yes" in run.err


def test_emulated_robots_have_nothing_to_abort(tmp_path: Path) -> None:
    run = run_here(tmp_path, "abort")
    assert run.code == 0
    assert "the robots of this backend run only while their lab runs" in run.out
