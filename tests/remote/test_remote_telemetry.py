"""The sampler of a robot's Wi-Fi link starts with the attempt, and stops when the folder is packed.

This machine has no Wi-Fi: `iw` is a program that prints outputs of real robots.
"""

import os
import shlex
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from typing_extensions import override

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import host, link
from fieldkit.measure.evidence.terminations import Cause
from fieldkit.remote import evidence, fetching, jobs, script
from tests.helpers.paths import DATA
from tests.helpers.sshd import wait_until
from tests.helpers.userlands import USERLANDS_OF_LONG_TESTS, LocalSession, LocalShell, userland_path

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


class ShellWithoutIw(LocalShell):
    """A robot on which iw is not installed: in its mount namespace a file that is not executable covers iw."""

    @override
    def begin(self, argv: Sequence[str], *, deadline: Deadline, until: bytes | None = None) -> LocalSession:
        path = f"{os.environ['PATH']}:/usr/sbin:/sbin"
        unshare, iw = shutil.which("unshare", path=path), shutil.which("iw", path=path)
        assert unshare
        if iw:
            cover_command = (
                unshare,
                "--map-root-user",
                "--mount",
                "sh",
                "-c",
                'mount --bind /dev/null "$0" && exec "$@"',
                iw,
            )
            argv = (*cover_command, *argv)
        return super().begin(argv, deadline=deadline, until=until)


def replace_iw(tmp_path: Path, link_file: str = "link-station") -> None:
    """Replace iw by a program that prints real outputs, and records its arguments."""
    answers = {"link": link_file, "station": "station-iwlwifi-6", "survey": "survey-mt7996-6", "info": "info-station"}
    files = {verb: shlex.quote(str(DATA / "iw" / f"{name}.txt")) for verb, name in answers.items()}
    # The outputs are from two machines, so the address of the access point is made the same.
    (link := tmp_path / "link.txt").write_text(
        (DATA / "iw" / f"{link_file}.txt").read_text().replace("f0:99:bf:0e:86:98", "04:f0:21:32:3f:d2")
    )
    files["link"] = shlex.quote(str(link))
    cases = "\n".join(f"{verb}) exec cat {file} ;;" for verb, file in files.items())
    iw = tmp_path / "bin" / "iw"
    query_log = shlex.quote(str(tmp_path / "queries"))
    iw.write_text(f'#!/bin/sh\necho "$*" >>{query_log}\ncase $3 in\n{cases}\n*) exit 1 ;;\nesac\n', encoding="utf-8")
    iw.chmod(0o755)


def begin(shell: LocalShell, min_samples: int = 3) -> Path:
    """Begin an attempt, and return the file when its link was sampled at least `min_samples` times."""
    evidence.begin(shell, FOLDER, "sender", "wlan0")
    sample_file = shell.home / FOLDER / "sender-link.txt"
    wait_until(
        lambda: sample_file.is_file() and sample_file.read_text().count(" station <==") >= min_samples,
        Deadline.after(60),
    )
    return sample_file


def test_link_is_sampled_until_its_folder_is_packed(shell: LocalShell, tmp_path: Path) -> None:
    replace_iw(tmp_path)
    sample_file = begin(shell)
    (line,) = jobs.list_running(shell, Deadline.after(30))
    assert line.startswith(".fieldkit/trial/udp-01-1/link "), "the sampler is identified like any job"
    assert line.endswith("sample the link of wlan0")
    evidence.begin(shell, FOLDER, "sender", "wlan0")
    assert len(jobs.list_running(shell, Deadline.after(30))) == 1, "a repeated begin joins the running sampler"
    into = tmp_path / "local"
    into.mkdir()
    fetching.fetch(shell, FOLDER, "sender", "wlan0", into)
    assert jobs.list_running(shell, Deadline.after(30)) == ()
    assert not sample_file.exists()
    assert (into / "sender-link.txt.gz").stat().st_size < 4000, "the samples are fetched in compressed form"
    samples = AttemptEvidence(into).links(Role.SENDER)
    measured = link.measure(Role.SENDER, samples)
    assert measured.values["sender_signal_median_dbm"] == -60.0
    assert measured.values["sender_noise_dbm"] == -84.0
    assert measured.values["sender_tx_failures"] == measured.values["sender_roams"] == 0
    after = host.read_state(into / "sender-after.txt")
    assert after.terminations is not None
    assert after.terminations["link"].cause is Cause.STOPPED
    query_log = (tmp_path / "queries").read_text().splitlines()
    assert "dev wlan0 station get 04:f0:21:32:3f:d2" in query_log, (
        "some drivers list the station of the access point nowhere else"
    )


def test_all_stations_of_an_access_point_are_sampled(shell: LocalShell, tmp_path: Path) -> None:
    replace_iw(tmp_path, "link-none")
    begin(shell)
    query_log = (tmp_path / "queries").read_text()
    assert "station dump" in query_log
    assert "station get" not in query_log
    evidence.end_jobs(shell, FOLDER)
    assert jobs.list_running(shell, Deadline.after(30)) == ()


@pytest.mark.parametrize("stop_method", ["abort", "end", "remove", "lock"])
def test_sampler_stops_with_the_attempt(shell: LocalShell, tmp_path: Path, stop_method: str) -> None:
    replace_iw(tmp_path, "link-none")
    if stop_method == "lock":
        script.call(shell, "lock", "mine", "600", "me", "trial", deadline=Deadline.after(30))
        evidence.begin(shell, FOLDER, "sender", "wlan0", token="mine")
        script.call(shell, "unlock", "mine", deadline=Deadline.after(30))
    else:
        begin(shell, min_samples=1)
    if stop_method == "abort":
        assert any("/link " in line for line in jobs.abort(shell, "somebody", Deadline.after(30)).jobs)
    elif stop_method == "end":
        evidence.end_all(shell, "trial")
    elif stop_method == "remove":
        evidence.discard_attempt(shell, FOLDER)
    wait_until(lambda: jobs.list_running(shell, Deadline.after(30)) == (), Deadline.after(60))


def test_sampler_exits_without_wifi_and_does_not_start_without_iw(shell: LocalShell, tmp_path: Path) -> None:
    evidence.begin(ShellWithoutIw(shell.home, shell.path), FOLDER, "sender", "wlan0")
    assert not (shell.home / FOLDER / ".jobs" / "link").exists()
    replace_iw(tmp_path)
    (tmp_path / "bin" / "iw").write_text("#!/bin/sh\necho 'command failed: No such device (-19)' >&2\nexit 237\n")
    evidence.begin(shell, f"{FOLDER}-2", "sender", "wlan0")
    exit_code = shell.home / f"{FOLDER}-2" / ".jobs" / "link" / "exit"
    wait_until(lambda: exit_code.is_file() and exit_code.read_text() == "0\n", Deadline.after(60))
    into = tmp_path / "local"
    into.mkdir()
    fetching.fetch(shell, f"{FOLDER}-2", "sender", "wlan0", into)
    assert link.measure(Role.SENDER, AttemptEvidence(into).links(Role.SENDER)).values == {}


def test_failed_sample_does_not_stop_the_sampler(shell: LocalShell, tmp_path: Path) -> None:
    # A station that is lost between the two requests of `iw link` is unknown to the kernel.
    replace_iw(tmp_path)
    iw, lost_station = tmp_path / "bin" / "iw", tmp_path / "lost"
    failing_command = "{ echo 'command failed: No such file or directory (-2)' >&2; exit 254; }"
    text = iw.read_text(encoding="utf-8")
    iw.write_text(
        text.replace("case $3", f"[ ! -e {shlex.quote(str(lost_station))} ] || {failing_command}\ncase $3"),
        encoding="utf-8",
    )
    sample_file = begin(shell)
    lost_station.touch()
    n_samples = sample_file.read_text().count(" link <==")
    # The first sample may be older, so a failed sample is certain only after a second one.
    wait_until(lambda: sample_file.read_text().count(" link <==") > n_samples + 1, Deadline.after(60))
    lost_station.unlink()
    n_connected = sample_file.read_text().count("Connected to ")
    wait_until(lambda: sample_file.read_text().count("Connected to ") > n_connected, Deadline.after(60))
    evidence.end_jobs(shell, FOLDER)


def test_unfetched_file_does_not_fill_the_disk(shell: LocalShell, tmp_path: Path) -> None:
    replace_iw(tmp_path)
    (tmp_path / "bin" / "iw").write_text("#!/bin/sh\nexec head -c 3000000 /dev/zero\n")
    evidence.begin(shell, FOLDER, "sender", "wlan0")
    exit_code = shell.home / FOLDER / ".jobs" / "link" / "exit"
    wait_until(exit_code.is_file, Deadline.after(60))
    assert (shell.home / FOLDER / "sender-link.txt").stat().st_size <= 8 << 20


@pytest.mark.parametrize("shell_command", [("dash",), ("busybox", "sh"), ("bash",)], ids=" ".join)
def test_link_is_sampled_in_each_shell(shell: LocalShell, tmp_path: Path, shell_command: tuple[str, ...]) -> None:
    replace_iw(tmp_path)
    folder = shell.home / FOLDER
    (folder / ".jobs" / "link").mkdir(parents=True)
    os.mkfifo(folder / ".jobs" / "link" / "end")
    (folder / ".began").write_text("- boot\n", encoding="ascii")
    output_file = folder / "output"
    with output_file.open("wb") as out:
        argv = (*shell_command, str(shell.home / script.SCRIPT_PATH), "sample", "wlan0", "-")
        sampler = subprocess.Popen(argv, cwd=folder, stdout=out, env=os.environ | {"PATH": shell.path})
    wait_until(lambda: output_file.read_bytes().count(b" station <==") >= 3, Deadline.after(60))
    shutil.rmtree(folder)
    assert sampler.wait(60) == 0, "the sampler exits when its folder is deleted"
