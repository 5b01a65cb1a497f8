"""Leases of robot programs: a program on a robot follows an order only while this laptop renews it.

If this process is killed, or the control link is down for longer than the lease, the order expires; the program
defines what the robot does then (`fieldkit.agent.orders`). While such a program runs, its robot counts as moving
(`steps.motions`).
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
from fieldkit.steps.nest import Nest, end_inside
from fieldkit.steps.scene import Announce, Scene

_POLL_S: Final = 0.25

# Writes the order $3 atomically into the file $2, and prints the program's output file $4. After the program has
# exited, the file $1 contains its exit code, which is printed to standard error.
_ORDER: Final = (
    'printf "%s\\n" "$3" >"$2.$$" && mv -f "$2.$$" "$2" && { cat "$4" 2>/dev/null; [ ! -s "$1" ] || cat "$1" >&2; }'
)


def orders_file(name: str) -> str:
    """Return the name of the file with the orders for the job `name`, in the folder of its attempt."""
    return f"{name}.orders"


@contextmanager
def start_program(shell: Shell, job: Job) -> Iterator[None]:
    """Install the agent on a robot and start one of its programs.

    The program is not stopped here: the body must stop it. Raises the same errors as `jobs.start`.
    """
    agent.install(shell)
    jobs.start(shell, job)
    yield


class LeaseKeeper:
    """Sends orders to a program and renews the last order until the context is left.

    Args:
        shell: Connection to the robot.
        job: The running program.
        output_file: File in the job's folder into which the program writes its progress.
        order: The first order.
        lease_s: Time in seconds until an order expires.
        renewals: Number of renewals in that time.
        silent_lease_s: Lease used instead of `lease_s` while the radio must stay silent, so that orders cannot be
            renewed; None if orders are renewed.

    Attributes:
        output: Content of the output file at the last renewal.
        exit_code: Exit code of the program at the last renewal, as text; empty while it runs.
    """

    def __init__(
        self,
        shell: Shell,
        job: Job,
        *,
        output_file: str,
        order: str,
        lease_s: float,
        renewals: int,
        silent_lease_s: float | None = None,
    ) -> None:
        self.output = b""
        self.exit_code = ""
        self._shell = shell
        self._job = job
        names = jobs.exit_file(job), orders_file(job.name), output_file
        self._exit_file, self._orders_file, self._output_file = (f"{job.folder}/{name}" for name in names)
        self._order = order
        self._lease_s = lease_s
        self._expires_s = lease_s if silent_lease_s is None else silent_lease_s
        self._renewal_s = None if silent_lease_s is not None else lease_s / renewals
        self._numbers = count(1)
        self._changed_s = time.monotonic()
        self._end_body: Callable[[], None] | None = None
        self._lock = threading.Lock()
        self._exit_event = threading.Event()
        self._thread = threading.Thread(target=self._renew_until_exit, name="lease", daemon=True)

    def __enter__(self) -> Self:
        self.renew()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._exit_event.set()
        self._thread.join()

    def give_order(self, order: str) -> None:
        """Give a new order. If this fails, the next renewal sends it again.

        Raises:
            LinkError: The robot did not answer.
            RobotError: The order could not be written on the robot.
        """
        with self._lock:
            self._order = order
        self.renew()

    def renew(self) -> bytes:
        """Renew the last order, and return the content of the output file. Raises the same errors as `give_order`."""
        return self._send(jobs.REPLY_S)

    def wait_for_next_poll(self) -> None:
        """Sleep for the interval at which callers poll the output."""
        time.sleep(_POLL_S)

    @property
    def end_reason(self) -> str:
        """The reason why the program ended early, from its output or exit code; empty while it runs."""
        return f"its program has ended with exit code {self.exit_code}" if self.exit_code else ""

    def failure(self, reason: str) -> RobotError:
        """Return the error of a program that failed for this reason."""
        return RobotError(reason, where=self._shell.robot, remedy=f"see {self._job.log} of this attempt")

    def check_running(self) -> None:
        """Check that the program has not ended early.

        Raises:
            RobotError: It has ended; the message is `end_reason`.
        """
        if self.end_reason:
            raise self.failure(self.end_reason)

    @contextmanager
    def run_while_leased(self, end: Callable[[], None]) -> Iterator[None]:
        """Run the body; abort it if the program ends.

        If orders are not renewed, the end of the program is detected only after the body has finished.

        Args:
            end: Aborts the operations that the body waits for. After the program has ended, it is called at each
                further renewal, because the body may have started to wait for another operation.

        Raises:
            RobotError: The program ended before the body. An error of the body is the cause of this error.
        """
        self._end_body = end
        try:
            yield
        except FieldkitError as error:
            if error.ends_trial or not self.end_reason:
                raise
            raise self.failure(self.end_reason) from error
        finally:
            self._end_body = None
        self.check_running()

    @property
    def unchanged_s(self) -> float:
        """Seconds since the content of the output file last changed."""
        return time.monotonic() - self._changed_s

    def _send(self, within_s: float) -> bytes:
        """Write the order with a new number on the robot, and read the program's output and exit code."""
        with self._lock:
            line = f"{next(self._numbers)} {self._order} {self._expires_s:g}"
        argv = ("sh", "-c", _ORDER, "sh", self._exit_file, self._orders_file, line, self._output_file)
        result = self._shell.run(argv, deadline=Deadline.after(within_s))
        *_, code = (b"", *result.stderr.splitlines())  # a login shell may print messages before the exit code
        self.exit_code = code.decode() if code.isdigit() else ""
        if result.stdout != self.output:
            self.output, self._changed_s = result.stdout, time.monotonic()
        return result.stdout

    def _renew_until_exit(self) -> None:
        while self._renewal_s is not None and not self._exit_event.wait(self._renewal_s):
            with suppress(FieldkitError):  # the link may be restored before the order expires
                self._send(min(self._lease_s, jobs.REPLY_S))
            end_body = self._end_body
            if end_body is not None and self.end_reason:
                end_body()


def run_inside(nest: Nest, keeper: LeaseKeeper, scene: Scene, testbed: Testbed, announce: Announce) -> None:
    """Run the steps inside `nest`; abort them if its leased program ends.

    Args:
        nest: The step whose inner steps are run.
        keeper: Keeper of the lease of the program.
        scene: The attempt; all running steps share it.
        testbed: The robots.
        announce: Called with the name and the expected duration of each phase.

    Raises the same errors as `run_while_leased`.
    """
    inner_scene = replace(scene, halt=scene.halt.child())

    def end() -> None:
        inner_scene.halt.set()
        with suppress(FieldkitError):  # it is called again at the next renewal
            end_inside(nest, inner_scene, testbed)

    with keeper.run_while_leased(end):
        for entry in nest.during:
            if not inner_scene.halt.is_set:
                entry.step.run(inner_scene, testbed, announce)
