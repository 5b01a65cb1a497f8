"""A control link is cut while a job runs and neither side sends data."""

import re
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkLostError
from fieldkit.core.model import Role, Topology
from fieldkit.remote import evidence, jobs
from fieldkit.remote.jobs import Job
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.testbed import EmulatedTestbed
from sim_backends.world.world import load_world
from tests.helpers.host import descendants
from tests.helpers.sshd import wait_until

pytestmark = pytest.mark.emulated

FOLDER = jobs.work_folder("dead", "link-1")
DETECTION_LIMIT_S = 10.0
ESTABLISHED = "01"
SOON = 60.0


class Robot:
    """An emulated robot, its control link, and the notices for the operator."""

    def __init__(self, emulation: EmulatedTestbed, notices: list[str]) -> None:
        self.shell = emulation.shells[Role.SENDER]
        self.notices = notices
        self.pid = emulation.robots[Role.SENDER].pid
        self.proc_folder = f"/proc/{min(descendants(self.pid))}"

    def set_link(self, state: str) -> None:
        subprocess.run(("nsenter", f"--net={self.proc_folder}/ns/net", "ip", "link", "set", "lo", state), check=True)

    def is_silent(self) -> bool:
        """Return True if no byte of any connection waits for its acknowledgement."""
        lines = Path(f"{self.proc_folder}/net/tcp").read_text(encoding="ascii").splitlines()[1:]
        return all(line.split()[4].startswith("00000000:") for line in lines if line.split()[3] == ESTABLISHED)

    def runs(self, text: str) -> bool:
        """Return True if a process of the robot has this text in its command line."""
        for pid in descendants(self.pid):
            with suppress(FileNotFoundError, ProcessLookupError):
                line = Path(f"/proc/{pid}/cmdline").read_bytes()
                if text in line.replace(b"\0", b" ").decode(errors="replace"):
                    return True
        return False

    def has(self, name: str) -> bool:
        return Path(f"{self.proc_folder}/root/root/{FOLDER}/{name}").exists()


@contextmanager
def robot(reconnect_timeout_s: float) -> Iterator[Robot]:
    cast = EmulatedBackend(None, None).cast(Topology.MASTERLESS)
    notices: list[str] = []
    with testbed.bring_up(
        cast,
        options=EmulatedOptions(),
        world=load_world("lawn"),
        ros=RosChoice.BUILTIN,
        seed=1,
        reconnect_timeout_s=reconnect_timeout_s,
        on_notice=notices.append,
    ) as emulation:
        robot_under_test = Robot(emulation, notices)
        jobs.install(robot_under_test.shell, Deadline.after(30))
        evidence.begin(robot_under_test.shell, FOLDER, "sender", "wlan0")
        yield robot_under_test


def silent_job(script: str) -> Job:
    return Job(folder=FOLDER, name="silent", argv=("sh", "-c", script), limit_s=120, log="silent.log")


@pytest.mark.quiet
def test_loss_of_a_silent_link_is_detected_within_10_s() -> None:
    with robot(reconnect_timeout_s=0.0) as emulated, ThreadPoolExecutor(1) as pool:
        # Standard input has ended and is acknowledged, so neither side sends anything afterwards.
        argv = ("sh", "-c", f"cat; touch {FOLDER}/up; sleep 60")
        future = pool.submit(emulated.shell.run, argv, deadline=Deadline.after(SOON))
        wait_until(lambda: emulated.has("up") and emulated.is_silent(), Deadline.after(SOON))
        emulated.set_link("down")
        cut_time_s = time.monotonic()
        with pytest.raises(LinkLostError, match="the connection broke during"):
            future.result(SOON)
        assert time.monotonic() - cut_time_s < DETECTION_LIMIT_S


def test_result_of_a_job_that_outlives_its_link_is_collected_once() -> None:
    with robot(reconnect_timeout_s=SOON) as emulated, ThreadPoolExecutor(1) as pool:
        future = pool.submit(
            jobs.run,
            emulated.shell,
            silent_job("touch up; until [ -e go ]; do sleep 0.05; done; echo end >>ends; exit 7"),
        )
        wait_until(lambda: emulated.has("up"), Deadline.after(SOON))
        emulated.set_link("down")
        wait_until(lambda: len(emulated.notices) == 1, Deadline.after(SOON))
        Path(f"{emulated.proc_folder}/root/root/{FOLDER}/go").touch()
        wait_until(lambda: emulated.has("ends"), Deadline.after(SOON))
        assert not future.done()
        emulated.set_link("up")
        assert future.result(SOON) == 7
        assert emulated.shell.run(("cat", f"{FOLDER}/ends"), deadline=Deadline.after(30)).stdout == b"end\n"
        assert [re.split(";| after", notice)[0] for notice in emulated.notices] == [
            "turtlebot-1: the link is lost",
            "turtlebot-1: the link is open again",
        ]


def test_wait_of_the_robot_for_a_cut_link_has_a_timeout() -> None:
    """The SSH server does not detect the loss, and keeps standard input open for hours."""
    with robot(reconnect_timeout_s=0.0) as emulated:
        pending = jobs.begin(emulated.shell, replace(silent_job("touch up"), limit_s=1, ready_s=1))
        wait_until(lambda: emulated.has("up"), Deadline.after(SOON))
        emulated.set_link("down")
        assert pending.session is not None, "the reference keeps the session open"
        assert emulated.runs(f"run {FOLDER} silent")
        wait_until(lambda: not emulated.runs(FOLDER), Deadline.after(SOON))
