"""The person at the terminal: what they are asked, and their Ctrl-C."""

import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

from fieldkit.core import prompts
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Answered, Asked, Entered, Request, Sink
from fieldkit.core.prompts import Answer, Question
from fieldkit.core.units import format_duration
from fieldkit.trial.running.stop import Stop

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_FINISHING: Final = "finishing the repeat that runs{left}; Ctrl-C again stops it now"
_STOPPING: Final = "stopping: ending what runs on the robots"
_ABANDONED: Final = "not waiting for confirmations any longer; the order to stop remains"
_CLEAR_LINE: Final = "\r\x1b[K"


class Terminal:
    """Asks whoever sits at this terminal.

    Args:
        sink: Told each request, which it shows, and the answer.
    """

    def __init__(self, sink: Sink) -> None:
        self._sink = sink

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        """See `Operator.ask`."""
        _demand_terminal(
            f"somebody must {request}",
            "place the robots first, then add --yes; or give the answers by --answers FILE",
        )
        self._sink(Request(request, may_skip))
        while (answer := prompts.parse(_typed(), may_skip=may_skip)) is None:
            print(prompts.how(may_skip=may_skip), file=sys.stderr)
        self._sink(Answered(answer.skip, answer.note))
        return answer

    def enter(self, question: Question) -> str:
        """See `Operator.enter`."""
        _demand_terminal(
            f"somebody must say: {question.text}", "give the answers by --answers FILE; with --yes nobody is asked"
        )
        self._sink(Asked(question.text, question.how))
        while (answer := question.read(_typed())) is None:
            print(question.how, file=sys.stderr)
        self._sink(Entered(answer))
        return answer


def _demand_terminal(what: str, remedy: str) -> None:
    if not sys.stdin.isatty():
        raise ConfigurationError(f"{what}, and there is no terminal to ask at", remedy=remedy)


def confirmed(question: str, *, unasked: str) -> bool:
    """Return whether the person at the terminal says yes.

    Args:
        question: In the imperative, without a question mark: `pin it`.
        unasked: The remedy where there is no terminal.

    Raises:
        ConfigurationError: There is no terminal to ask at.
    """
    if not sys.stdin.isatty():
        raise ConfigurationError(f"somebody must say yes to: {question}", remedy=unasked)
    print(f"{question}? yes or no", file=sys.stderr)
    while (answer := _typed().strip().lower()) not in {"yes", "no"}:
        print("yes or no", file=sys.stderr)
    return answer == "yes"


def _typed() -> str:
    """Return a line from the terminal; the prompt goes where it is in nobody's way."""
    print("> ", end="", file=sys.stderr, flush=True)
    try:
        return input()
    except EOFError as error:
        raise ConfigurationError("the terminal was closed at a question", remedy="start again") from error


@contextmanager
def interruptible() -> Iterator[Stop]:
    """Turn Ctrl-C into a request to stop while the body runs.

    While a robot moves by itself, or may begin to, the first SIGINT, SIGTERM or SIGHUP orders all robots to stop and
    raises `KeyboardInterrupt`; leaving the body waits for the confirmations, and the next signal ends that wait.
    Otherwise the first SIGINT lets the repeat end, and the second raises `KeyboardInterrupt`, as SIGTERM and SIGHUP
    do at once: a closed terminal does not wait. What comes after that is ignored, since the clean-up that follows is
    bounded by its own deadlines.

    A thread gives the order: the signal reaches it by a descriptor (`signal.set_wakeup_fd`), also while the main
    thread cannot run a handler.
    """
    stop = Stop()
    stopping = False

    def take(number: int, _frame: FrameType | None) -> None:
        nonlocal stopping
        if stopping:
            if stop.motions.called:
                stop.motions.abandon()
                _say(_ABANDONED)
            return
        if stop.motions.order(_say):
            stopping = stop.due = True
            if not stop.saving:
                raise KeyboardInterrupt
            return
        if number == signal.SIGINT and stop.patient and not stop.asked:
            stop.asked = True
            left = f", about {format_duration(stop.left_s)} more" if stop.left_s else ""
            _say(_FINISHING.format(left=left))
            return
        stopping = True
        _say(_STOPPING)
        stop.due = True
        if not stop.saving:
            raise KeyboardInterrupt

    with _watched(stop):
        before = {number: signal.signal(number, take) for number in _SIGNALS}
        try:
            yield stop
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextmanager
def _watched(stop: Stop) -> Iterator[None]:
    """Let a thread order robots to stop when a signal comes, whatever the main thread does."""
    ours, kernels = socket.socketpair()

    def watch() -> None:
        while numbers := ours.recv(64):
            if any(number in _SIGNALS for number in numbers):
                stop.motions.order(_say)

    thread = threading.Thread(target=watch, name="signals", daemon=True)
    with ours, kernels:
        kernels.setblocking(False)
        thread.start()
        before = signal.set_wakeup_fd(kernels.fileno(), warn_on_full_buffer=False)
        try:
            yield
        finally:
            signal.set_wakeup_fd(before)
            kernels.shutdown(socket.SHUT_RDWR)
            thread.join()


def _say(text: str) -> None:
    """Write past every buffer, over the live line: the signal may have come in the middle of another write."""
    start = _CLEAR_LINE if sys.stderr.isatty() else "\n"
    try:
        os.write(sys.stderr.fileno(), f"{start}{text}\n".encode())
    except OSError:
        return  # the terminal is gone, which may be why we stop
