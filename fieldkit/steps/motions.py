"""Robots that a program of ours moves just now, and the order of the operator to stop them all at once.

The order may come from a signal handler, from any thread, and more than once. It goes to each robot from a thread of
its own, on the control connection that is open already, while the main thread waits for something else.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from fieldkit.remote.motion import Halted
    from fieldkit.remote.shell import Shell

WHO: Final = "the-operator"
"""Named on a robot as who stopped it."""

STOPPED: Final = "stopped by the operator"
"""The reason of a void repeat, and of a hold, after the order to stop."""

_ANSWERS_S: Final = 3.0
"""After this long without an answer a robot is reported as out of reach; a control connection answers in 0.1 s."""
_LOOKS_S: Final = 0.5
_LANDS_S: Final = 600.0
"""For this long a landing is awaited, as long as the pilot does (`fieldkit.agent.landing`)."""
_WAKE_S: Final = 0.5

Tell = Callable[[str], None]
"""Shows a line to the operator, from any thread."""


class Mover(NamedTuple):
    """A robot that a program of ours moves.

    Attributes:
        robot: Its name.
        shell: Its control connection.
        folder: The folder of the attempt on it.
        alone: What the robot does by itself where no order reaches it, as in "it stops by itself within 2 s".
    """

    robot: str
    shell: "Shell"
    folder: str
    alone: str


class Motions:
    """The robots that move, and the order to stop.

    Attributes:
        ahead: What robots do where they are stopped, a line for each, while the steps of a repeat run in which they
            move by themselves; empty otherwise. No robot begins to move after the order.
        called: Whether the order was given; for good.
    """

    def __init__(self) -> None:
        self.ahead: tuple[str, ...] = ()
        self.called = False
        self._movers: list[Mover] = []
        self._first = threading.Lock()  # acquired once, by whoever gives the order first
        self._abandoned = threading.Event()
        self._done = threading.Event()

    @contextmanager
    def moving(self, mover: Mover) -> Iterator[None]:
        """Let a robot move while the body runs; after an order to stop, wait for its confirmation.

        Raises:
            KeyboardInterrupt: The order was given before: the robot does not begin to move.
        """
        self._movers.append(mover)  # before the look at `called`, which `order` sets before it looks at this
        try:
            if self.called:
                raise KeyboardInterrupt
            yield
        finally:
            while self.called and not self._done.wait(_WAKE_S):
                pass  # Python sees a signal that came just before it blocked only when it wakes
            self._movers.remove(mover)

    def order(self, tell: Tell) -> bool:
        """Order all robots to stop if any moves or may begin to; return whether that is so.

        Args:
            tell: Shows what becomes of each, in one line.
        """
        if not (self._movers or self.ahead):
            return False
        self.called = True
        if self._first.acquire(blocking=False):
            movers = {mover.robot: mover for mover in reversed(self._movers)}
            threading.Thread(target=self._stop, args=(tuple(movers.values()), tell), name="stop", daemon=True).start()
        return True

    def abandon(self) -> None:
        """Do not wait for confirmations any longer; the order to stop remains."""
        self._abandoned.set()
        self._done.set()

    def _stop(self, movers: tuple[Mover, ...], tell: Tell) -> None:
        threads = [threading.Thread(target=self._halt, args=(mover, tell), daemon=True) for mover in movers]
        for thread in threads:
            thread.start()
        for line in self.ahead if movers else ():
            tell(f"stopping: {line}")
        if not movers:
            tell("stopping: no robot begins to move; ending what runs on the robots")
        for thread in threads:
            thread.join()
        self._done.set()

    def _halt(self, mover: Mover, tell: Tell) -> None:
        """Stop one robot, and wait until it is stationary or on the ground."""
        from fieldkit.core.deadline import Deadline  # noqa: PLC0415 (loaded where robots move)
        from fieldkit.core.errors import FieldkitError  # noqa: PLC0415
        from fieldkit.remote import motion  # noqa: PLC0415

        began_s = time.monotonic()
        try:
            halted = motion.halt_attempt(mover.shell, mover.folder, WHO, Deadline.after(_ANSWERS_S))
            tell(self._said(mover, halted, began_s))
            while halted.state in motion.COMING_DOWN and time.monotonic() < began_s + _LANDS_S:
                if self._abandoned.wait(_LOOKS_S):
                    return
                names = [name for name, _ in halted.programs]
                halted = motion.look(mover.shell, names, Deadline.after(_ANSWERS_S))
                if halted.state not in motion.COMING_DOWN:
                    tell(self._said(mover, halted, began_s))
        except FieldkitError as error:
            tell(f"no answer from {mover.robot}: {mover.alone} ({error.what})")

    @staticmethod
    def _said(mover: Mover, halted: "Halted", began_s: float) -> str:
        from fieldkit.remote import motion  # noqa: PLC0415

        return f"{mover.robot}: {motion.IN_WORDS[halted.state]}, {time.monotonic() - began_s:.1f} s after the order"
