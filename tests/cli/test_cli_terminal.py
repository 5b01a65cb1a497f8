"""The person at a terminal: asked on a line that nothing redraws, asked again, and free to leave."""

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

ASK = """
import sys
from threading import Thread
from fieldkit.cli import INTERRUPTED
from fieldkit.cli.display import watching
from fieldkit.cli.terminal import Terminal
from fieldkit.core.events import Event, Note, PhaseStarted, Request
def told(event: Event) -> None:
    sink(event)
    if isinstance(event, Request):
        Thread(target=sink, args=[Note("link lost")]).start()
try:
    with watching(as_json=False) as sink:
        sink(PhaseStarted("connect"))
        sink(PhaseStarted("work", repeat="tcp-01"))
        answer = Terminal(told).ask("move a", may_skip=True)
        sink(PhaseStarted("go on"))
except KeyboardInterrupt:
    sys.exit(INTERRUPTED)
print(answer)
"""


class Person:
    """Reads and types at the other end of a terminal."""

    def __init__(self, terminal: int) -> None:
        self._terminal = terminal
        self._decode = codecs.getincrementaldecoder("utf-8")().decode  # a character may come in two pieces
        self.read = ""

    def wait_for(self, *texts: str) -> None:
        ends = time.monotonic() + WITHIN_S
        start = len(self.read)
        while not all(text in self.read[start:] for text in texts):
            assert time.monotonic() < ends, self.read
            self.sees(WITHIN_S)

    def sees(self, within_s: float) -> str:
        """Return what appears next, empty if nothing does in time."""
        if not select.select([self._terminal], [], [], within_s)[0]:
            return ""
        new = self._decode(os.read(self._terminal, 4096))
        self.read += new
        return new

    def type(self, text: str) -> None:
        os.write(self._terminal, text.encode())


@contextmanager
def asked(*words: str, lab: Path | None = None) -> Iterator[tuple[Person, "subprocess.Popen[bytes]"]]:
    """Run `ASK`, or python with `words` in the folder `lab`, at a terminal."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        (sys.executable, *(words or ("-c", ASK))),
        cwd=lab,
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
    )
    os.close(theirs)
    try:
        yield Person(ours), process
    finally:
        process.kill()
        process.wait(WITHIN_S)
        os.close(ours)


def test_nothing_is_drawn_while_a_question_stands() -> None:
    with asked() as (person, _):
        person.wait_for("\n> ", "link lost\r\n")
        assert "work" in person.read
        assert "move a" in person.read
        assert "s to leave it for later" in person.read
        # The live line is drawn eight times a second.
        assert person.sees(0.6) == ""


def test_a_meaningless_answer_is_asked_again_and_a_note_is_kept() -> None:
    with asked() as (person, process):
        person.wait_for("\n> ")
        person.type("what?\n")
        person.wait_for("\n> ")
        person.type("n wet grass\n")
        person.wait_for("Answer(skip=False, note='wet grass')")
        assert "go on" in person.read
        assert process.wait(WITHIN_S) == 0


def test_a_terminal_that_closes_is_an_error() -> None:
    with asked() as (person, process):
        person.wait_for("\n> ")
        person.type("\x04")
        person.wait_for("the terminal was closed during a question")
        assert process.wait(WITHIN_S) == 1


def test_an_abort_that_is_refused_ends_nothing(tmp_path: Path) -> None:
    key = " ".join(make_key(tmp_path / "key").split()[:2])
    robot = f"{{profile: duckiedrone, host: localhost, port: {free_port()}, user: nobody, host_key: {key}}}"
    site = f"backend: field\nrobots:\n  a: {robot}\nroles: {{}}\n"
    (tmp_path / SITE_FILE).write_text(site, encoding="utf-8")
    with asked("-m", "fieldkit", "abort", lab=tmp_path) as (person, process):
        person.wait_for("terminate every job of fieldkit on a? yes or no", "\n> ")
        person.type("no\n")
        person.wait_for("nothing was terminated")
        assert process.wait(WITHIN_S) == 1


def reads_standard_input(process: "subprocess.Popen[bytes]") -> bool:
    """Return whether it sleeps in a system call whose first argument is descriptor 0."""
    return Path(f"/proc/{process.pid}/syscall").read_text(encoding="ascii").split()[1:2] == ["0x0"]


def test_ctrl_c_ends_a_question() -> None:
    with asked() as (person, process):
        person.wait_for("\n> ")
        # Python loses a signal that comes between its last look and the system call that waits. A second one may
        # come when Python has ended its own handler, and then kills.
        wait_until(lambda: reads_standard_input(process), Deadline.after(WITHIN_S))
        process.send_signal(signal.SIGINT)
        assert process.wait(WITHIN_S) == INTERRUPTED
