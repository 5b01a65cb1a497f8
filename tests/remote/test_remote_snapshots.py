"""Snapshots of the state of a robot in each userland: outputs, failures, time limits and sizes.

The programs that report the state are scripts that print real outputs.
"""

import shlex
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.measure.robot_state import chrony, clock_states, health, snapshots
from fieldkit.remote import evidence, fetching, jobs, script
from tests.helpers.paths import DATA
from tests.helpers.sshd import wait_until
from tests.helpers.userlands import USERLANDS_OF_LONG_TESTS, LocalShell, userland_path

pytestmark = pytest.mark.emulated

FOLDER = jobs.work_folder("trial", "udp-01-1")


@pytest.fixture(params=USERLANDS_OF_LONG_TESTS)
def shell(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[LocalShell]:
    home = tmp_path / "home"
    home.mkdir()
    local_shell = LocalShell(home, userland_path(request.param, tmp_path / "bin"))
    jobs.install(local_shell, Deadline.after(30))
    yield local_shell
    wait_until(lambda: jobs.list_running(local_shell, Deadline.after(30)) == (), Deadline.after(60))


def add_program(tmp_path: Path, name: str, text: str) -> None:
    """Add a program to the robot."""
    path = tmp_path / "bin" / name
    path.write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
    path.chmod(0o755)


def take_snapshot(shell: LocalShell) -> snapshots.Snapshot:
    text = script.call(shell, "snapshot", deadline=Deadline.after(60)).decode()
    assert not [path for path in (shell.home / ".fieldkit").iterdir() if path.name.startswith(".sources")]
    return snapshots.parse(text)


def test_snapshots_of_an_attempt_are_fetched(shell: LocalShell, tmp_path: Path) -> None:
    calls = tmp_path / "calls"
    add_program(
        tmp_path,
        "chronyc",
        f'echo "$*" >>{shlex.quote(str(calls))}; cat {shlex.quote(str(DATA))}/chrony/none-4.3.csv',
    )
    evidence.begin(shell, FOLDER, "sender", "wlan0")
    evidence.begin(shell, FOLDER, "sender", "wlan0")
    (tmp_path / "local").mkdir()
    fetching.fetch(shell, FOLDER, "sender", "wlan0", tmp_path / "local")
    for name in ("sender-sources-before.txt", "sender-sources-after.txt"):
        report = chrony.parse(snapshots.read(tmp_path / "local" / name)["chrony"])
        assert report.problem == "chrony has no source"
    assert calls.read_text().splitlines() == ["-n -c tracking"] * 2, "no names are resolved, and no call is repeated"


def test_the_clock_is_reported_at_intervals_until_the_sampler_is_stopped(shell: LocalShell, tmp_path: Path) -> None:
    """The clock loses its source during the attempt; the sampler is stopped while a program hangs."""
    installed = shell.home / script.SCRIPT_PATH
    text = installed.read_text(encoding="ascii")
    assert "CLOCK_INTERVAL=10 " in text
    installed.write_text(text.replace("CLOCK_INTERVAL=10 ", "CLOCK_INTERVAL=1 "), encoding="ascii")
    count = tmp_path / "count"
    add_program(
        tmp_path,
        "chronyc",
        f"echo x >>{shlex.quote(str(count))}\n"
        f"case $(wc -l <{shlex.quote(str(count))}) in\n"
        "*1) file=synchronized-4.3 ;; *5) exec sleep 600 ;; *) file=none-4.3 ;;\n"
        "esac\n"
        f"cat {shlex.quote(str(DATA))}/chrony/$file.csv",
    )
    script.call(shell, "lock", "mine", "600", "me", "trial", deadline=Deadline.after(30))
    evidence.begin(shell, FOLDER, "sender", "wlan0", token="mine")
    wait_until(lambda: len(count.read_text().splitlines()) == 5, Deadline.after(60))
    (tmp_path / "local").mkdir()
    fetching.fetch(shell, FOLDER, "sender", "wlan0", tmp_path / "local")
    before = snapshots.read(tmp_path / "local" / "sender-sources-before.txt")
    during = snapshots.read_series(tmp_path / "local" / "sender-sources-during.txt")
    assert chrony.parse(before["chrony"]).is_synchronized
    assert all(snapshot.keys() == {"chrony"} for snapshot in during)
    assert [chrony.parse(snapshot["chrony"]).problem for snapshot in during[:3]] == ["chrony has no source"] * 3
    clock = clock_states.read("robot", (before, *during), None)
    assert clock.report is not None
    assert clock.report.problem == "chrony has no source", "the less favourable report is used"
    assert not [path for path in (shell.home / ".fieldkit" / FOLDER).rglob("*") if path.name.startswith(".clock-")]


def test_programs_that_hang_or_flood_give_no_value_and_hardly_delay_a_snapshot(
    shell: LocalShell, tmp_path: Path
) -> None:
    add_program(tmp_path, "chronyc", "sleep 600")
    add_program(tmp_path, "pmc", "yes 'offset 0'")
    started_s = time.monotonic()
    snapshot = take_snapshot(shell)
    assert time.monotonic() - started_s < 20, "the limit is 2 s; this machine may be busy"
    assert snapshot["chrony"].failure == "did not answer in time"
    assert snapshot["ptp"].failure is not None
    assert len(snapshot["ptp"].text) <= 64 * 1024
    assert all(report.offset_s is None for report in clock_states.reports(snapshot))


def test_a_source_that_hung_is_not_started_again_in_the_trial(shell: LocalShell, tmp_path: Path) -> None:
    calls = tmp_path / "calls"
    add_program(tmp_path, "chronyc", f"echo chronyc >>{shlex.quote(str(calls))}; exec sleep 600")
    add_program(tmp_path, "iw", "exec sleep 600")
    add_program(tmp_path, "pmc", f"echo pmc >>{shlex.quote(str(calls))}; echo 'code 137'")
    folders = [FOLDER, jobs.work_folder("trial", "udp-02-1")]
    for number, folder in enumerate(folders):
        evidence.begin(shell, folder, "sender", "wlan0")
        local = tmp_path / f"local-{number}"
        local.mkdir()
        fetching.fetch(shell, folder, "sender", "wlan0", local)
        for name in ("sender-sources-before.txt", "sender-sources-after.txt"):
            snapshot = snapshots.read(local / name)
            assert [snapshot[source].failure for source in ("chrony", "iw-info", "ptp")] == [
                "did not answer in time",
                "did not answer in time",
                None,
            ]
    # The sampler of the link also starts iw.
    started = calls.read_text().splitlines()
    assert (started.count("chronyc"), started.count("pmc")) == (1, 4)
    evidence.discard(shell, "trial", kept_folders=folders[1:])
    assert [path.name for path in (shell.home / ".fieldkit" / "trial").iterdir()] == [folders[1].rpartition("/")[2]]


def test_a_robot_without_these_programs_reports_the_state_of_its_computer(shell: LocalShell, tmp_path: Path) -> None:
    add_program(tmp_path, "chronyc", "exit 3")
    (tmp_path / "bin" / "chronyc").chmod(0o644)
    snapshot = take_snapshot(shell)
    assert "chrony" not in snapshot
    state = health.parse(snapshot)
    assert state.all_ticks is not None
    assert state.busy_ticks is not None
    assert 0 < state.busy_ticks < state.all_ticks
    assert state.disk_free_bytes is not None
    assert state.disk_free_bytes == pytest.approx(shutil.disk_usage(shell.home).free, rel=0.2)
