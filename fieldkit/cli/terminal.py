"""The person at the terminal: questions to this person, and Ctrl-C."""

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
_STOPPING: Final = "stopping: terminating the programs on the robots"
_WAIT_CANCELLED: Final = "no longer waiting for confirmations; the order to stop was sent"
_CLEAR_LINE: Final = "\r\x1b[K"


class Terminal:
    """An operator who answers at this terminal.

    Args:
        sink: Receives each request, which it shows, and the answer.
    """

    def __init__(self, sink: Sink) -> None:
        self._sink = sink

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        """Ask the operator to do something, as `Operator.ask`."""
        _require_terminal(
            f"a person must {request}",
            "place the robots first, then add --yes; or give the answers by --answers FILE",
        )
        self._sink(Request(request, may_skip))
        while (answer := prompts.parse(_read_line(), may_skip=may_skip)) is None:
            print(prompts.answer_hint(may_skip=may_skip), file=sys.stderr)
        self._sink(Answered(answer.skip, answer.note))
        return answer

    def enter(self, question: Question) -> str:
        """Ask the operator for a value, as `Operator.enter`."""
        _require_terminal(
            f"a person must answer: {question.text}",
            "give the answers by --answers FILE; with --yes no question is asked",
        )
        self._sink(Asked(question.text, question.answer_hint))
        while (answer := question.read(_read_line())) is None:
            print(question.answer_hint, file=sys.stderr)
        self._sink(Entered(answer))
        return answer


def _require_terminal(what: str, remedy: str) -> None:
    if not sys.stdin.isatty():
        raise ConfigurationError(f"{what}, but standard input is not a terminal", remedy=remedy)


def confirmed(question: str, *, remedy: str) -> bool:
    """Return True if the person at the terminal answers yes.

    Args:
        question: In the imperative, without a question mark: `pin it`.
        remedy: The remedy if there is no terminal.

    Raises:
        ConfigurationError: Standard input is not a terminal.
    """
    if not sys.stdin.isatty():
        raise ConfigurationError(f"a person must confirm: {question}", remedy=remedy)
    print(f"{question}? yes or no", file=sys.stderr)
    while (answer := _read_line().strip().lower()) not in {"yes", "no"}:
        print("yes or no", file=sys.stderr)
    return answer == "yes"


def _read_line() -> str:
    """Return a line from the terminal. The prompt goes to standard error, apart from the output."""
    print("> ", end="", file=sys.stderr, flush=True)
    try:
        return input()
    except EOFError as error:
        raise ConfigurationError(
            "the terminal was closed during a question", remedy="run the command again"
        ) from error


@contextmanager
def interruptible() -> Iterator[Stop]:
    """Turn Ctrl-C into a request to stop while the body runs.

    While a robot moves without a person, or may start to move, the first SIGINT, SIGTERM or SIGHUP orders all robots
    to stop and raises `KeyboardInterrupt`. At the end of the body the function waits for their confirmations; the
    next signal cancels that wait. Otherwise the first SIGINT lets the repeat finish, and the second raises
    `KeyboardInterrupt`. SIGTERM and SIGHUP raise it immediately, because a closed terminal does not wait. Later
    signals are ignored, since the clean-up that follows has its own deadlines.

    A thread gives the order. It receives signals by a descriptor (`signal.set_wakeup_fd`), also while the main thread
    cannot run a handler.
    """
    stop = Stop()
    stopping = False

    def handle(number: int, _frame: FrameType | None) -> None:
        nonlocal stopping
        if stopping:
            if stop.motions.is_ordered:
                stop.motions.abandon()
                _write_message(_WAIT_CANCELLED)
            return
        if stop.motions.order_stop(_write_message):
            stopping = stop.after_saving = True
            if not stop.saving:
                raise KeyboardInterrupt
            return
        if number == signal.SIGINT and stop.can_finish and not stop.after_repeat:
            stop.after_repeat = True
            remaining_text = f", about {format_duration(stop.left_s)} more" if stop.left_s else ""
            _write_message(_FINISHING.format(left=remaining_text))
            return
        stopping = True
        _write_message(_STOPPING)
        stop.after_saving = True
        if not stop.saving:
            raise KeyboardInterrupt

    with _stop_thread(stop):
        before = {number: signal.signal(number, handle) for number in _SIGNALS}
        try:
            yield stop
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextmanager
def _stop_thread(stop: Stop) -> Iterator[None]:
    """Run a thread that orders robots to stop at a signal, independent of the main thread."""
    receiver, sender = socket.socketpair()

    def watch() -> None:
        while numbers := receiver.recv(64):
            if any(number in _SIGNALS for number in numbers):
                stop.motions.order_stop(_write_message)

    thread = threading.Thread(target=watch, name="signals", daemon=True)
    with receiver, sender:
        sender.setblocking(False)
        thread.start()
        before = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
        try:
            yield
        finally:
            signal.set_wakeup_fd(before)
            sender.shutdown(socket.SHUT_RDWR)
            thread.join()


def _write_message(text: str) -> None:
    """Write unbuffered over the live line, because the signal may have interrupted another write."""
    start = _CLEAR_LINE if sys.stderr.isatty() else "\n"
    try:
        os.write(sys.stderr.fileno(), f"{start}{text}\n".encode())
    except OSError:
        return  # the terminal was closed, which may be the cause of the signal
