"""A lease on what a robot does: a program on it follows an order for only as long as this laptop renews it.

If this process is killed, or the control link is cut for longer than the lease, the order lapses; the program defines
what the robot does then (`fieldkit.agent.orders`). While one runs, its robot counts as moving (`steps.motions`).
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import count
from typing import Final, Self

from fieldkit.backends.protocols import Testbed
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError, RobotError
from fieldkit.remote import agent, jobs
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.steps.nest import Nest
from fieldkit.steps.scene import Announce, Scene

_LOOKS_S: Final = 0.25

# Writes $3 into the file $2, whole or not at all, and prints what the program has said in $4; on standard error its
# exit code, which is in $1 once it has ended.
_ORDER: Final = (
    'printf "%s\\n" "$3" >"$2.$$" && mv -f "$2.$$" "$2" && { cat "$4" 2>/dev/null; [ ! -s "$1" ] || cat "$1" >&2; }'
)


def orders_file(name: str) -> str:
    """Return the file of orders of the job `name`, in the folder of its attempt."""
    return f"{name}.orders"


@contextmanager
def started(shell: Shell, job: Job) -> Iterator[None]:
    """Bring the agent to a robot and start a program of it, which the body ends; errors as `jobs.start`."""
    agent.install(shell)
    jobs.start(shell, job)
    yield


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
        code: Its exit code then, as text; empty while it runs.
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
        self.code = ""
        self._shell = shell
        self._job = job
        names = jobs.exit_file(job), orders_file(job.name), says
        self._exit, self._orders, self._says = (f"{job.folder}/{name}" for name in names)
        self._order = order
        self._lease_s = lease_s
        self._holds_s = lease_s if unheard_s is None else unheard_s
        self._pause_s = None if unheard_s is not None else lease_s / renewals
        self._numbers = count(1)
        self._said_s = time.monotonic()
        self._end: Callable[[], None] | None = None
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
    def over(self) -> str:
        """Why the program is at its end before it was to be, as it or its exit code says; empty where it is not."""
        return f"its program has ended with exit code {self.code}" if self.code else ""

    def failure(self, why: str) -> RobotError:
        """Return the error of a program that did not do what it was to."""
        return RobotError(why, where=self._shell.robot, remedy=f"see {self._job.log} of this attempt")

    def demand(self) -> None:
        """Go on only if the program does.

        Raises:
            RobotError: It is at its end; says why.
        """
        if self.over:
            raise self.failure(self.over)

    @contextmanager
    def outlasting(self, end: Callable[[], None]) -> Iterator[None]:
        """Run the body for as long as the program goes on; where nothing may be sent meanwhile, until its own end.

        Args:
            end: Ends what the body waits for. With each renewal it is called anew: the body may have begun to wait
                for something else.

        Raises:
            RobotError: The program ended before the body did. What the body raises then is the work of that.
        """
        self._end = end
        try:
            yield
        except FieldkitError as error:
            if error.ends_trial or not self.over:
                raise
            raise self.failure(self.over) from error
        finally:
            self._end = None
        self.demand()

    @property
    def unchanged_s(self) -> float:
        """For how long nobody has seen the program say anything new."""
        return time.monotonic() - self._said_s

    def _send(self, within_s: float) -> bytes:
        with self._turn:
            line = f"{next(self._numbers)} {self._order} {self._holds_s:g}"
        words = ("sh", "-c", _ORDER, "sh", self._exit, self._orders, line, self._says)
        done = self._shell.run(words, deadline=Deadline.after(within_s))
        *_, code = (b"", *done.stderr.splitlines())  # a login shell may say something, too
        self.code = code.decode() if code.isdigit() else ""
        if done.stdout != self.said:
            self.said, self._said_s = done.stdout, time.monotonic()
        return done.stdout

    def _renew(self) -> None:
        while self._pause_s is not None and not self._left.wait(self._pause_s):
            with suppress(FieldkitError):  # the link may come back before the order has lapsed
                self._send(min(self._lease_s, jobs.REPLY_S))
            end = self._end
            if end is not None and self.over:
                end()


def run_inside(nest: Nest, held: HeldLease, scene: Scene, testbed: Testbed, announce: Announce) -> None:
    """Run the steps inside one for as long as the program goes on that it has on a robot; errors as `outlasting`."""
    inner = replace(scene, halt=scene.halt.inside())

    def end() -> None:
        inner.halt.call()
        with suppress(FieldkitError):  # it is called anew
            nest.end_inside(inner, testbed)

    with held.outlasting(end):
        for entry in nest.during:
            if not inner.halt.called:
                entry.step.run(inner, testbed, announce)
