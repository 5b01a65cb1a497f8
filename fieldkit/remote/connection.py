"""The connection to one robot, which is opened at its first use, and reopened after a loss until a timeout."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Final, TypeVar

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError, LinkLostError
from fieldkit.core.units import format_duration
from fieldkit.remote.identity import Address, Credentials
from fieldkit.remote.link import BROKEN, Link, LoginRefusedError
from fieldkit.remote.login import closed_error, log_in
from fieldkit.remote.persistent_shells import ShellPool
from fieldkit.remote.sockets import Connect, Timing

T = TypeVar("T")

_POLL_S: Final = 0.2
"""Interval between checks whether packets may be sent again, because the measurement may end early."""


class Connection:
    """A connection to a robot. It has at most one link at a time, which all threads share.

    Args:
        address: Address of the robot.
        connect: Opens the stream.
        credentials: Host key and login.
        reconnect_timeout_s: Time after the loss of a link during which attempts to reopen it are made.
        on_notice: Called with a line of text when the link is lost, and when it is restored.
        crosses_radio: Whether the link crosses the radio under test.
        timing: Timeouts of the link.

    Attributes:
        address: Address of the robot.
        shells: The persistent shells on the link.
    """

    def __init__(
        self,
        address: Address,
        connect: Connect,
        credentials: Credentials,
        *,
        reconnect_timeout_s: float,
        on_notice: Callable[[str], None],
        crosses_radio: bool,
        timing: Timing,
    ) -> None:
        self.address = address
        self.shells = ShellPool()
        self._connect = connect
        self._credentials = credentials
        self._reconnect_timeout_s = reconnect_timeout_s
        self._on_notice = on_notice
        self._crosses_radio = crosses_radio
        self._timing = timing
        self._connecting = threading.Lock()  # held by the thread that logs in
        self._lock = threading.Lock()  # protects the attributes below; no thread waits while it holds this lock
        # `close` sets this event and replaces it with a new one. A wait uses the event that was present at its start.
        self._close_event = threading.Event()
        self._link: Link | None = None
        self._was_up = False
        self._lost_at_s: float | None = None
        self._reopened_at_s: float | None = None
        self._pause_s, self._suppress_notices = timing.pause_s, False
        self._silent_periods: list[Deadline] = []

    @property
    def close_event(self) -> threading.Event:
        """An event that the next call of `close` sets."""
        return self._close_event

    def link(self, deadline: Deadline) -> Link:
        """Return the link, which is opened again if it is not alive.

        Raises the same errors as `log_in`, and `LinkLostError` if another thread logs in for too long, or if the link
        is lost while no packets may be sent.
        """
        close_event, limit = self._close_event, deadline.earlier_of(self._timing.connect_s)
        if not self._connecting.acquire(timeout=limit.remaining_s):
            raise LinkLostError("another command is still connecting", where=self.address.robot)
        try:
            link = self._link
            if link is not None and link.alive:
                return link
            if self._was_up and self._silence_s():
                raise LinkLostError("the link is lost, and the radio is being measured", where=self.address.robot)
            link = log_in(
                self.address,
                self._connect,
                self._credentials,
                timing=self._timing,
                deadline=limit,
                close_event=close_event,
            )
            with self._lock:
                if close_event.is_set():
                    link.close()
                    raise closed_error(self.address)
                lost_at_s, self._lost_at_s = self._lost_at_s, None
                self._reopened_at_s = time.monotonic() if self._was_up else None
                self._link, self._was_up = link, True
        finally:
            self._connecting.release()
        if lost_at_s is not None and not self._suppress_notices:
            duration = format_duration(time.monotonic() - lost_at_s)
            self._on_notice(f"{self.address.robot}: the link is open again after {duration}")
        return link

    def run_with_retries(self, attempt: Callable[[Deadline], T], deadline: Deadline) -> T:
        """Return the result of `attempt`, which is repeated after each loss of the link.

        Only a link that was open before is reopened, so that a wrong address is reported immediately. A repeated
        attempt has at least `Timing.reply_s`. The total time is at most the time until `deadline`, plus
        `reconnect_timeout_s`, the time of one login, `Timing.reply_s`, and the silences (`silence`) during which the
        link is not reopened.

        Raises:
            LinkError: The deadline passed with an open link, the link was not restored, or `close` was called.
            FieldkitError: `attempt` or `log_in` raised it.
        """
        close_event, final_deadline = self._close_event, Deadline(deadline.at_s + self._reconnect_timeout_s)
        while True:
            try:
                return attempt(deadline)
            except (LinkError, LoginRefusedError) as error:
                if close_event.is_set():
                    raise closed_error(self.address) from error
                if not isinstance(error, (LinkLostError, LoginRefusedError)) or not self._was_up:
                    raise
                self._wait_for_link(error, final_deadline, close_event)
            deadline = deadline.later_of(self._timing.reply_s)

    def _wait_for_link(
        self, error: LinkLostError | LoginRefusedError, final_deadline: Deadline, close_event: threading.Event
    ) -> None:
        """Wait until the link is open again.

        The last error is raised after `reconnect_timeout_s`, or at `final_deadline`.

        If a robot that accepted the login before refuses it now, the robot is assumed to be booting.
        """
        with self._lock:
            if self._link is not None and self._link.alive:
                return  # another thread has reopened the link
            is_first = self._lost_at_s is None
            if is_first:
                self._register_loss()
            lost_at_s = self._lost_at_s = self._lost_at_s or time.monotonic()
        silence_s = self._wait_for_end_of_silence(error, close_event, notify=is_first)
        end = Deadline(min(final_deadline.at_s, lost_at_s + silence_s + self._reconnect_timeout_s))
        if is_first and not silence_s and not self._suppress_notices:
            self._notify_lost(end)
        pause_s = self._pause_s
        while not end.expired:
            if close_event.wait(min(pause_s, end.remaining_s)):
                raise closed_error(self.address) from error
            try:
                self.link(end.later_of(self._timing.connect_s))
            except (LinkLostError, LoginRefusedError) as retry_error:
                error, pause_s = retry_error, min(2 * pause_s, self._timing.probe_s)
                if self._suppress_notices:
                    self._suppress_notices = False
                    self._notify_lost(end)
            else:
                return
        raise error

    def _register_loss(self) -> None:
        """Suppress notices and double the pause if the link was lost shortly after it was reopened.

        Otherwise a server that disconnects after each login would cause many attempts and notices per second.
        """
        reopened_at_s = self._reopened_at_s
        self._suppress_notices = reopened_at_s is not None and time.monotonic() - reopened_at_s < self._timing.probe_s
        self._pause_s = (
            min(2 * self._pause_s, self._timing.probe_s) if self._suppress_notices else self._timing.pause_s
        )

    def _notify_lost(self, end: Deadline) -> None:
        if not end.expired:
            duration = format_duration(end.remaining_s)
            self._on_notice(f"{self.address.robot}: the link is lost; trying again for {duration}")

    def _wait_for_end_of_silence(self, error: Exception, close_event: threading.Event, *, notify: bool) -> float:
        """Wait until packets may be sent again.

        Returns:
            The expected duration of the silence when the wait started, in seconds; 0 without a silence.

        Raises:
            LinkError: `close` was called.
        """
        initial_s = self._silence_s()
        if initial_s and notify:
            wait = format_duration(initial_s)
            self._on_notice(
                f"{self.address.robot}: the link is lost; it is not reopened while its radio is being "
                f"measured, for up to {wait}"
            )
        while silence_s := self._silence_s():
            if close_event.wait(min(_POLL_S, silence_s)):
                raise closed_error(self.address) from error
        return initial_s

    def open_spare_channels(self, link: Link, shell_command: str | None) -> None:
        """Start to open channels for later commands.

        While the radio is being measured, no channels are opened, because this would send packets.

        Args:
            link: The link of a command that has ended.
            shell_command: The command that starts a persistent shell; None to open no shell.

        Raises:
            EOFError: The link is not connected.
        """
        with self._lock:
            if self._silence_s():
                return
            link.open_spare_channels()
            if shell_command is not None:
                self.shells.restore(link, shell_command)

    @contextmanager
    def silence(self, seconds: float) -> Iterator[None]:
        """Send no packets on the link during the body, if it crosses the radio under test; see `Shell.silence`.

        Keepalive probes are not sent either, so the link is not closed for lack of answers during this time. The
        body starts when no channel is being opened any more.
        """
        if not self._crosses_radio:
            yield
            return
        link = self._link
        try:
            with ExitStack() as stack:
                with self._block_opening(self._timing.reply_s) as limit:
                    if link is not None:
                        link.wait_until_open(limit)
                        self.shells.wait_until_open(limit)
                    stack.enter_context(self._block_opening(seconds))
                self._extend_timeout(link, max(seconds, self._silence_s()))
                yield
        finally:
            self._extend_timeout(link, self._silence_s())

    @contextmanager
    def _block_opening(self, seconds: float) -> Iterator[Deadline]:
        """Prevent all threads from opening a link, channel or shell during the body, for at most `seconds`.

        Several steps may measure at the same time; the latest end applies.
        """
        end = Deadline.after(seconds)
        with self._lock:
            self._silent_periods.append(end)
        try:
            yield end
        finally:
            with self._lock:
                self._silent_periods = [silence for silence in self._silent_periods if silence is not end]

    def _extend_timeout(self, link: Link | None, seconds: float) -> None:
        if link is not None:
            with suppress(*BROKEN):  # the next use of the link reports the error
                link.extend_timeout(seconds)

    def _silence_s(self) -> float:
        """Return the remaining time in which no link, channel or shell may be opened; 0 if they may be opened."""
        return max((silence.remaining_s for silence in self._silent_periods), default=0.0)

    def close(self) -> None:
        """Close the link, and end all waits for it in other threads."""
        with self._lock:
            self._close_event.set()
            self._close_event = threading.Event()
            link, self._link = self._link, None
            self._was_up, self._lost_at_s, self._silent_periods = False, None, []
        if link is not None:
            link.close()
