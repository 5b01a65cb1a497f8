"""The robots that fieldkit currently moves, and the operator's order to stop all of them immediately.

The order may come from a signal handler, from any thread, and more than once. A separate thread sends it to each
robot on the open control connection, while the main thread may be waiting for another operation.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final, Protocol

STOPPED: Final = "stopped by the operator"
"""Reason that is stored after the order to stop. The repeat is void for this reason, and no robot may move until a
person permits it."""

_WAIT_S: Final = 0.5
"""Duration of one wait for confirmations, after which Python can run signal handlers."""

Report = Callable[[str], None]
"""Shows a line to the operator, from any thread."""


class Mover(Protocol):
    """A robot that a program of fieldkit moves."""

    @property
    def robot(self) -> str:
        """Name of the robot."""
        ...

    def stop(self, report: Report, cancel_event: threading.Event) -> None:
        """Stop the robot, and wait until it is stationary or on the ground; errors are reported, not raised.

        Args:
            report: Receives a line for each change of state of the robot.
            cancel_event: Set if the operator cancels the wait.
        """
        ...


class Motions:
    """The moving robots, and the order to stop. After the order no robot starts to move.

    Attributes:
        stop_notes: While steps run in which robots move automatically, a line for each robot about its behaviour when
            it is stopped; empty at other times.
        stop_ordered: Whether the order to stop was given; it cannot be withdrawn.
    """

    def __init__(self) -> None:
        self.stop_notes: tuple[str, ...] = ()
        self.stop_ordered = False
        self._movers: list[Mover] = []
        self._first_order_lock = threading.Lock()  # acquired once, by the first order
        self._cancel_event = threading.Event()
        self._done_event = threading.Event()

    @contextmanager
    def moving(self, mover: Mover) -> Iterator[None]:
        """Register a robot as moving while the body runs; after an order to stop, wait for its confirmation.

        Raises:
            KeyboardInterrupt: The order was given before; the robot must not start to move.
        """
        # The robot is added before `stop_ordered` is read, because `order_stop` sets `stop_ordered` before it reads
        # the list.
        self._movers.append(mover)
        try:
            if self.stop_ordered:
                raise KeyboardInterrupt
            yield
        finally:
            # Each wait is short, because Python handles a signal that arrived just before a wait only after the wait.
            while self.stop_ordered and not self._done_event.wait(_WAIT_S):
                pass
            self._movers.remove(mover)

    def order_stop(self, report: Report) -> bool:
        """Order all robots to stop; return False and do nothing if no robot moves or may start to move.

        Args:
            report: Receives a line for each change of state of a robot.
        """
        if not (self._movers or self.stop_notes):
            return False
        self.stop_ordered = True
        if self._first_order_lock.acquire(blocking=False):
            # If a robot was registered more than once, its first mover stops it.
            movers = {mover.robot: mover for mover in reversed(self._movers)}
            threading.Thread(
                target=self._stop, args=(tuple(movers.values()), report), name="stop", daemon=True
            ).start()
        return True

    def cancel_wait(self) -> None:
        """Stop waiting for confirmations; the order to stop remains in force."""
        self._cancel_event.set()
        self._done_event.set()

    def _stop(self, movers: tuple[Mover, ...], report: Report) -> None:
        """Stop the robots at the same time, and wait for their confirmations."""
        threads = [
            threading.Thread(target=mover.stop, args=(report, self._cancel_event), daemon=True) for mover in movers
        ]
        for thread in threads:
            thread.start()
        for line in self.stop_notes if movers else ():
            report(f"stopping: {line}")
        if not movers:
            report("stopping: no robot moves; stopping the programs on the robots")
        for thread in threads:
            thread.join()
        self._done_event.set()
