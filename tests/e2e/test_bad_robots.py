"""The errors of robots and connections in the last section of docs/errors.md, reproduced on emulated robots."""

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from tests.e2e.test_bad_inputs import Row, check, table
from tests.helpers import labs
from tests.helpers.field_robots import FieldRobots, start_field_robots
from tests.helpers.runs import fieldkit, run_here
from tests.helpers.sshd import free_port, make_key

pytestmark = pytest.mark.emulated

TRIAL = "trial los 5m --topology masterless --protocol tcp --repeats 1 --record 1s --yes"
MAKE_FOLDER = "mkdir -p .fieldkit/other/one/.jobs"


class Testbed:
    """The folder of a lab with the site file of running robots; a case changes both."""

    def __init__(self, folder: Path, field_robots: FieldRobots) -> None:
        self.folder = folder
        self.field_robots = field_robots
        self.undo = ExitStack()
        self._write("fieldkit.yaml", (field_robots.folder / "fieldkit.yaml").read_text(encoding="utf-8"))

    def change(self, pattern: str, replacement: str) -> None:
        """Replace a pattern in the sender's line of the site file."""
        lines = (self.folder / "fieldkit.yaml").read_text(encoding="utf-8").splitlines()
        (index,) = (number for number, line in enumerate(lines) if "turtlebot-1: {" in line)
        changed_line = re.sub(pattern, replacement, lines[index])
        assert changed_line != lines[index]
        lines[index] = changed_line
        self._write("fieldkit.yaml", "\n".join(lines) + "\n")

    def run_on(self, role: Role, script: str) -> None:
        shell = self.field_robots.testbed.shells[role]
        shell.run(("sh", "-c", script), deadline=Deadline.after(20))

    def start(self, role: Role, *argv: str) -> None:
        """Start a job on a robot; it is stopped at the end of the case."""
        shell = self.field_robots.testbed.shells[role]
        jobs.install(shell, Deadline.after(30))
        self.run_on(role, MAKE_FOLDER)
        job = Job(".fieldkit/other/one", "job", argv, limit_s=120, log="log")
        jobs.start(shell, job)
        self.undo.callback(self.run_on, role, "rm -r .fieldkit/other")
        self.undo.callback(jobs.stop, shell, job)

    def _write(self, name: str, text: str) -> None:
        (self.folder / name).write_text(text, encoding="utf-8")


Setup = Callable[[Testbed], str]


def site(pattern: str, replacement: str) -> Setup:
    def setup(lab: Testbed) -> str:
        lab.change(pattern, replacement)
        return TRIAL

    return setup


def profile(old: str, new: str) -> Setup:
    def setup(lab: Testbed) -> str:
        labs.copy_shipped(lab.folder, "robots", "turtlebot3_burger", old, new)
        return TRIAL

    return setup


def procedure(old: str, new: str) -> Setup:
    def setup(lab: Testbed) -> str:
        labs.copy_shipped(lab.folder, "procedures", "los", old, new)
        return TRIAL

    return setup


def closed_port(lab: Testbed) -> str:
    lab.change(r"port: \d+", f"port: {free_port()}")
    return TRIAL


def changed_key(lab: Testbed) -> str:
    other_key = " ".join(make_key(lab.folder / "other").split()[:2])
    lab.change(r"host_key: [^}]*", f"host_key: {other_key}")
    return TRIAL


def unauthorized_login(lab: Testbed) -> str:
    make_key(lab.folder / "stranger")
    lab.change(r"key: \S+login", f"key: {lab.folder}/stranger")
    return TRIAL


def occupied_port(lab: Testbed) -> str:
    listens = "grep -q '^ *[0-9]*: 00000000:04D2 ' /proc/net/tcp"
    start = "setsid -f nc.traditional -l -p 1234 </dev/null >/dev/null 2>&1"
    lab.run_on(Role.RECEIVER, f"{start}; until {listens}; do sleep 0.05; done")
    stop = "nc.traditional -q 0 127.0.0.1 1234 </dev/null"
    lab.undo.callback(lab.run_on, Role.RECEIVER, f"{stop}; while {listens}; do sleep 0.05; done")
    return TRIAL


def leftover_job(lab: Testbed) -> str:
    lab.start(Role.SENDER, "sleep", "100")
    return TRIAL


def full_robot(lab: Testbed) -> str:
    lab.run_on(Role.SENDER, "mkdir -p .fieldkit && mount -t tmpfs -o size=20m tmpfs .fieldkit")
    # The shells of a connection that was just closed may still run in the folder.
    lab.undo.callback(lab.run_on, Role.SENDER, "until umount .fieldkit; do sleep 0.1; done")
    return TRIAL


def unused_address(lab: Testbed) -> str:
    return TRIAL.removesuffix(" --yes")


ON_ROBOTS: dict[str, Setup] = {
    "an unknown host name": site(r"host: 127.0.0.1", "host: turtlebot.invalid"),
    "a robot that does not listen": closed_port,
    "a wrong user": site("user: root", "user: pi"),
    "a login key that is not authorized on the robot": unauthorized_login,
    "a missing login key": site(r"key: \S+login", "key: /no/such/key"),
    "a host key that changed": changed_key,
    "an invalid host key": site(r"host_key: [^}]*", "host_key: AAAA"),
    "an address that the robot does not have": site("address: 10.42.0.1", "address: 10.42.0.77"),
    "an interface that the robot does not have": profile("interface: wlan0", "interface: wlan7"),
    "a missing tool": profile("netcat: nc.traditional", "netcat: nc.imaginary"),
    "a missing setup file": profile("/opt/ros/noetic/setup.bash", "/opt/ros/melodic/setup.bash"),
    "no right to capture": profile("capture_right: direct", "capture_right: sudo"),
    "a port that is in use": occupied_port,
    "a job left by another trial": leftover_job,
    "a robot whose disk is full": full_robot,
    "a topic without messages": procedure("[/scan]", "[/nothing]"),
    "no person to place the robots": unused_address,
}


@pytest.fixture(scope="module")
def field_robots(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FieldRobots]:
    with start_field_robots(tmp_path_factory.mktemp("field")) as robots:
        yield robots


@contextmanager
def prepared(folder: Path, field_robots: FieldRobots) -> Iterator[Testbed]:
    lab = Testbed(folder, field_robots)
    with lab.undo:
        yield lab


def test_the_page_lists_the_tested_errors() -> None:
    assert list(table("On the robots")) == list(ON_ROBOTS)


@pytest.mark.parametrize("row", table("On the robots").values(), ids=lambda row: row.situation)
def test_an_error_of_a_robot_gives_one_message_with_a_remedy(
    row: Row, field_robots: FieldRobots, tmp_path: Path
) -> None:
    with prepared(tmp_path, field_robots) as lab:
        words = ON_ROBOTS[row.situation](lab).split()
        run = run_here(tmp_path, *words) if "--yes" in words else fieldkit(tmp_path, *words)  # without a terminal
    check(row, run.code, run.err)
