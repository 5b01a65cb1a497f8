"""A lease on what a robot does: a program on it follows an order for only as long as this laptop renews it.

Who kills this process, or cuts the control link for longer than the lease, lets the order lapse; what the robot does
then is for its program to know (`fieldkit.agent.orders`).
"""

import threading
import time
from contextlib import suppress
from itertools import count
from typing import Final, Self

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError
from fieldkit.remote import agent, jobs
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell

_LOOKS_S: Final = 0.25

# Writes $2 into the file $1, whole or not at all, and prints what the program has said in $3.
_ORDER: Final = 'printf "%s\\n" "$2" >"$1.$$" && mv -f "$1.$$" "$1" && { cat "$3" 2>/dev/null || :; }'


def orders_file(name: str) -> str:
    """Return the file of orders of the job `name`, in the folder of its attempt."""
    return f"{name}.orders"


def start(shell: Shell, job: Job) -> None:
    """Bring the agent to a robot and start a program of it; errors as `jobs.start`."""
    agent.install(shell)
    jobs.start(shell, job)


class HeldLease:
    """Gives a program orders, and renews the last one until the context is left.

    Args:
        shell: The robot.
        job: The program, which runs.
        says: The file in the job's folder in which it says how far it is.
        order: The first order.
        lease_s: For how long an order holds.
        renewals: How often it is renewed in that time.
        unheard_s: For how long an order holds where nothing may be sent meanwhile; None where it is renewed.

    Attributes:
        said: What the program had said when it was looked at last.
    """

    def __init__(
        self,
        shell: Shell,
        job: Job,
        *,
        says: str,
        order: str,
        lease_s: float,
        renewals: int,
        unheard_s: float | None = None,
    ) -> None:
        self.said = b""
        self._shell = shell
        self._files = tuple(f"{job.folder}/{name}" for name in (orders_file(job.name), says))
        self._order = order
        self._lease_s = lease_s
        self._holds_s = lease_s if unheard_s is None else unheard_s
        self._pause_s = None if unheard_s is not None else lease_s / renewals
        self._numbers = count(1)
        self._said_s = time.monotonic()
        self._turn = threading.Lock()
        self._left = threading.Event()
        self._thread = threading.Thread(target=self._renew, name="lease", daemon=True)

    def __enter__(self) -> Self:
        self.look()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._left.set()
        self._thread.join()

    def order(self, order: str) -> None:
        """Give an order, which holds from now on; where it is not taken now, it is with the next renewal.

        Raises:
            LinkError: The robot did not answer.
            RobotError: It could not take it.
        """
        with self._turn:
            self._order = order
        self.look()

    def look(self) -> bytes:
        """Give the last order again, and return what the program has said; errors as `order`."""
        return self._send(jobs.REPLY_S)

    def pause(self) -> None:
        """Wait a moment before the next look."""
        time.sleep(_LOOKS_S)

    @property
    def unchanged_s(self) -> float:
        """For how long nobody has seen the program say anything new."""
        return time.monotonic() - self._said_s

    def _send(self, within_s: float) -> bytes:
        with self._turn:
            line = f"{next(self._numbers)} {self._order} {self._holds_s:g}"
        orders, says = self._files
        done = self._shell.run(("sh", "-c", _ORDER, "sh", orders, line, says), deadline=Deadline.after(within_s))
        if done.stdout != self.said:
            self.said, self._said_s = done.stdout, time.monotonic()
        return done.stdout

    def _renew(self) -> None:
        while self._pause_s is not None and not self._left.wait(self._pause_s):
            with suppress(FieldkitError):  # the link may come back before the order has lapsed
                self._send(min(self._lease_s, jobs.REPLY_S))
