"""Ctrl-C and other signals that stop a trial."""

import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

from fieldkit.core.units import format_duration
from fieldkit.trial.running.stop import Stop

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_FINISHING: Final = "finishing the current repeat{left}; Ctrl-C again stops it now"
_STOPPING: Final = "stopping: terminating the programs on the robots"
_WAIT_CANCELLED: Final = "no longer waiting for confirmations; the order to stop was sent"
_CLEAR_LINE: Final = "\r\x1b[K"


@contextmanager
def interruptible() -> Iterator[Stop]:
    """Turn Ctrl-C into a request to stop while the body runs.

    While a robot moves automatically, or may start to move, the first SIGINT, SIGTERM or SIGHUP orders all robots
    to stop and raises `KeyboardInterrupt`. The step that moves a robot then waits for the confirmation of the robot
    (`Motions.moving`); the next signal cancels that wait.

    While no robot moves, the first SIGINT during a repeat lets the repeat finish, and the second raises
    `KeyboardInterrupt`. SIGINT between repeats, SIGTERM and SIGHUP raise it immediately: after SIGTERM or SIGHUP the
    system may kill this process before the repeat has finished. Later signals are ignored, because the clean-up that
    follows has deadlines.

    `KeyboardInterrupt` is delayed while the trial writes files that must not be left incomplete (`Stop.saving`).

    A thread gives the order to stop. It receives signals through a file descriptor (`signal.set_wakeup_fd`), even
    while the main thread cannot run a handler.
    """
    stop = Stop()
    stopping = False

    def handle(number: int, _frame: FrameType | None) -> None:
        nonlocal stopping
        if stopping:
            if stop.motions.stop_ordered:
                stop.motions.cancel_wait()
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
        previous = {number: signal.signal(number, handle) for number in _SIGNALS}
        try:
            yield stop
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)


@contextmanager
def _stop_thread(stop: Stop) -> Iterator[None]:
    """Run a thread that orders robots to stop at a signal, even if the main thread is blocked."""
    receiver, sender = socket.socketpair()

    def watch() -> None:
        while numbers := receiver.recv(64):
            if any(number in _SIGNALS for number in numbers):
                stop.motions.order_stop(_write_message)

    thread = threading.Thread(target=watch, name="signals", daemon=True)
    with receiver, sender:
        sender.setblocking(False)
        thread.start()
        previous = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
        try:
            yield
        finally:
            signal.set_wakeup_fd(previous)
            sender.shutdown(socket.SHUT_RDWR)
            thread.join()


def _write_message(text: str) -> None:
    """Write unbuffered over the live line, because the signal may have interrupted another write."""
    start = _CLEAR_LINE if sys.stderr.isatty() else "\n"
    try:
        os.write(sys.stderr.fileno(), f"{start}{text}\n".encode())
    except OSError:
        return  # the terminal was closed, which may be the cause of the signal
