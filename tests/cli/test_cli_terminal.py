"""Questions at a terminal are not redrawn, are repeated after an invalid answer, and are ended by Ctrl-C."""

import codecs
import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fieldkit.cli import INTERRUPTED
from fieldkit.config.locations import SITE_FILE
from fieldkit.core.deadline import Deadline
from tests.helpers.sshd import free_port, make_key, wait_until

WITHIN_S = 60.0

ASK_PROGRAM = """
import sys
from threading import Thread
from fieldkit.cli import INTERRUPTED
from fieldkit.cli.display import showing_events
from fieldkit.cli.operators import Terminal
from fieldkit.core.events import Event, Note, PhaseStarted, Request
def forward(event: Event) -> None:
    sink(event)
    if isinstance(event, Request):
        Thread(target=sink, args=[Note("link lost")]).start()
try:
    with showing_events(as_json=False) as sink:
        sink(PhaseStarted("connect"))
        sink(PhaseStarted("work", repeat="tcp-01"))
        answer = Terminal(forward).ask("move a", may_skip=True)
        sink(PhaseStarted("go on"))
except KeyboardInterrupt:
    sys.exit(INTERRUPTED)
print(answer)
"""


class Operator:
    """The operator at the other side of a pseudo-terminal."""

    def __init__(self, terminal: int) -> None:
        self._terminal = terminal
        self._decode = codecs.getincrementaldecoder("utf-8")().decode  # a character may be split between two reads
        self.output = ""

    def wait_for(self, *texts: str) -> None:
        deadline_s = time.monotonic() + WITHIN_S
        start_index = len(self.output)
        while not all(text in self.output[start_index:] for text in texts):
            assert time.monotonic() < deadline_s, self.output
            self.read_new(WITHIN_S)

    def read_new(self, within_s: float) -> str:
        """Return the next output, empty after a timeout."""
        if not select.select([self._terminal], [], [], within_s)[0]:
            return ""
        new_output = self._decode(os.read(self._terminal, 4096))
        self.output += new_output
        return new_output

    def type(self, text: str) -> None:
        os.write(self._terminal, text.encode())


@contextmanager
def run_at_terminal(*arguments: str, lab: Path | None = None) -> Iterator[tuple[Operator, "subprocess.Popen[bytes]"]]:
    """Run `ASK_PROGRAM`, or Python with `arguments` in the folder `lab`, at a pseudo-terminal."""
    controller, terminal = pty.openpty()
    process = subprocess.Popen(
        (sys.executable, *(arguments or ("-c", ASK_PROGRAM))),
        cwd=lab,
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        start_new_session=True,
    )
    os.close(terminal)
    try:
        yield Operator(controller), process
    finally:
        process.kill()
        process.wait(WITHIN_S)
        os.close(controller)


def test_nothing_is_drawn_during_a_question() -> None:
    with run_at_terminal() as (operator, _):
        operator.wait_for("\n> ", "link lost\r\n")
        assert "work" in operator.output
        assert "move a" in operator.output
        assert "s to leave it for later" in operator.output
        # The progress line is drawn 8 times per second.
        assert operator.read_new(0.6) == ""


def test_question_repeats_after_an_invalid_answer_and_keeps_a_note() -> None:
    with run_at_terminal() as (operator, process):
        operator.wait_for("\n> ")
        operator.type("what?\n")
        operator.wait_for("\n> ")
        operator.type("n wet grass\n")
        operator.wait_for("Answer(skip=False, note='wet grass')")
        assert "go on" in operator.output
        assert process.wait(WITHIN_S) == 0


def test_a_terminal_that_closes_is_an_error() -> None:
    with run_at_terminal() as (operator, process):
        operator.wait_for("\n> ")
        operator.type("\x04")
        operator.wait_for("the terminal was closed during a question")
        assert process.wait(WITHIN_S) == 1


def test_abort_that_is_not_confirmed_terminates_nothing(tmp_path: Path) -> None:
    key = " ".join(make_key(tmp_path / "key").split()[:2])
    robot = f"{{profile: duckiedrone, host: localhost, port: {free_port()}, user: nobody, host_key: {key}}}"
    site = f"backend: field\nrobots:\n  a: {robot}\nroles: {{}}\n"
    (tmp_path / SITE_FILE).write_text(site, encoding="utf-8")
    with run_at_terminal("-m", "fieldkit", "abort", lab=tmp_path) as (operator, process):
        operator.wait_for("terminate every job of fieldkit on a? yes or no", "\n> ")
        operator.type("no\n")
        operator.wait_for("nothing was terminated")
        assert process.wait(WITHIN_S) == 1


def reads_standard_input(process: "subprocess.Popen[bytes]") -> bool:
    """Return True if the process waits in a system call whose first argument is descriptor 0."""
    return Path(f"/proc/{process.pid}/syscall").read_text(encoding="ascii").split()[1:2] == ["0x0"]


def test_ctrl_c_ends_a_question() -> None:
    with run_at_terminal() as (operator, process):
        operator.wait_for("\n> ")
        # Python misses a signal that arrives between its last check and the blocking system call. A second signal
        # may arrive after Python has removed its handler, and then kills the process.
        wait_until(lambda: reads_standard_input(process), Deadline.after(WITHIN_S))
        process.send_signal(signal.SIGINT)
        assert process.wait(WITHIN_S) == INTERRUPTED
