"""The connection to one robot: made when first needed, made again when it was lost, for as long as patience lasts."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Final, TypeVar

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError, LinkLostError
from fieldkit.core.units import format_duration
from fieldkit.remote.identity import Address, Credentials
from fieldkit.remote.link import BROKEN, Connect, Link, LoginRefusedError, Timing
from fieldkit.remote.login import closed, log_in
from fieldkit.remote.standing import Standing

T = TypeVar("T")

_LOOK_S: Final = 0.2


class Connection:
    """One link at a time, shared by all threads.

    Args:
        address: Where the robot is.
        connect: Opens the stream.
        credentials: Who proves what.
        patience_s: How long a lost link is awaited, counted from its loss.
        notice: Told in one line when the link is lost, and when it is back.
        on_air: Whether the link crosses the radio under test.
        timing: How long it waits.

    Attributes:
        address: Likewise.
        standing: The shells that stay open on it.
    """

    def __init__(
        self,
        address: Address,
        connect: Connect,
        credentials: Credentials,
        *,
        patience_s: float,
        notice: Callable[[str], None],
        on_air: bool,
        timing: Timing,
    ) -> None:
        self.address = address
        self.standing = Standing()
        self._connect = connect
        self._credentials = credentials
        self._patience_s = patience_s
        self._notice = notice
        self._on_air = on_air
        self._timing = timing
        self._connecting = threading.Lock()  # held by the one thread that logs in
        self._lock = threading.Lock()  # of what follows; nobody waits while holding it
        self._ended = threading.Event()  # set by `close`; whoever waits holds the one of when it began
        self._link: Link | None = None
        self._was_up = False
        self._lost_at_s: float | None = None
        self._made_at_s: float | None = None
        self._pause_s, self._quiet = timing.pause_s, False
        self._silences: list[Deadline] = []

    @property
    def ended(self) -> threading.Event:
        """Set when `close` is called next."""
        return self._ended

    def link(self, deadline: Deadline) -> Link:
        """Return the link, made anew where there is none that lives; errors as `log_in`."""
        ended, within = self._ended, deadline.sooner(self._timing.connect_s)
        if not self._connecting.acquire(timeout=within.remaining_s):
            raise LinkLostError("another command is still connecting", where=self.address.robot)
        try:
            link = self._link
            if link is not None and link.alive:
                return link
            if self._was_up and self._silence_s():
                raise LinkLostError("the link is lost, and the radio is being measured", where=self.address.robot)
            link = log_in(
                self.address, self._connect, self._credentials, timing=self._timing, deadline=within, ended=ended
            )
            with self._lock:
                if ended.is_set():
                    link.close()
                    raise closed(self.address)
                lost_at_s, self._lost_at_s = self._lost_at_s, None
                self._made_at_s = time.monotonic() if self._was_up else None
                self._link, self._was_up = link, True
        finally:
            self._connecting.release()
        if lost_at_s is not None and not self._quiet:
            gone = format_duration(time.monotonic() - lost_at_s)
            self._notice(f"{self.address.robot}: the link is back after {gone}")
        return link

    def persist(self, attempt: Callable[[Deadline], T], deadline: Deadline) -> T:
        """Return what `attempt` returns; made again each time the link was lost and came back.

        The first link is not awaited: who mistyped an address is told at once. An attempt made again has a reply's
        time at least, so that all of it ends by `deadline`, the patience, a last login, and that time.

        Raises:
            LinkError: The deadline passed with the link up, the link did not come back, or `close` was called.
            FieldkitError: As `attempt` and `log_in`.
        """
        ended, last = self._ended, Deadline(deadline.at_s + self._patience_s)
        while True:
            try:
                return attempt(deadline)
            except (LinkError, LoginRefusedError) as error:
                if ended.is_set():
                    raise closed(self.address) from error
                if not isinstance(error, (LinkLostError, LoginRefusedError)) or not self._was_up:
                    raise
                self._wait_for_link(error, last, ended)
            deadline = deadline.later(self._timing.reply_s)

    def _wait_for_link(
        self, error: LinkLostError | LoginRefusedError, last: Deadline, ended: threading.Event
    ) -> None:
        """Return when there is a link again; raise what went wrong last when patience or `last` ends.

        A robot that let us in before and now refuses is one that boots.
        """
        with self._lock:
            if self._link is not None and self._link.alive:
                return  # another thread noticed sooner, and has made a new one
            first = self._lost_at_s is None
            if first:
                self._take_in_loss()
            lost_at_s = self._lost_at_s = self._lost_at_s or time.monotonic()
        silence_s = self._sit_out_silence(error, ended, tell=first)
        until = Deadline(min(last.at_s, lost_at_s + silence_s + self._patience_s))
        if first and not silence_s and not self._quiet:
            self._tell_lost(until)
        pause_s = self._pause_s
        while not until.expired:
            if ended.wait(min(pause_s, until.remaining_s)):
                raise closed(self.address) from error
            try:
                self.link(until.later(self._timing.connect_s))
            except (LinkLostError, LoginRefusedError) as again:
                error, pause_s = again, min(2 * pause_s, self._timing.probe_s)
                if self._quiet:
                    self._quiet = False
                    self._tell_lost(until)
            else:
                return
        raise error

    def _take_in_loss(self) -> None:
        """Be quiet, and wait longer, where a link that was made anew did not last.

        A server that lets us in and then breaks off would be asked many times a second, and be told every time.
        """
        made_at_s = self._made_at_s
        self._quiet = made_at_s is not None and time.monotonic() - made_at_s < self._timing.probe_s
        self._pause_s = min(2 * self._pause_s, self._timing.probe_s) if self._quiet else self._timing.pause_s

    def _tell_lost(self, until: Deadline) -> None:
        if not until.expired:
            patience = format_duration(until.remaining_s)
            self._notice(f"{self.address.robot}: the link is lost; trying again for {patience}")

    def _sit_out_silence(self, error: Exception, ended: threading.Event, *, tell: bool) -> float:
        """Wait until the radio is not measured any more; return how many seconds that was to take."""
        began_s = self._silence_s()
        if began_s and tell:
            wait = format_duration(began_s)
            self._notice(f"{self.address.robot}: the link is lost; for {wait} at most its radio is being measured")
        while silence_s := self._silence_s():
            if ended.wait(min(_LOOK_S, silence_s)):
                raise closed(self.address) from error
        return began_s

    def replenish(self, link: Link, standing: str | None) -> None:
        """Begin to open what commands to come need, unless the radio is being measured, as that takes packets.

        Args:
            link: What carried a command that has ended.
            standing: What starts a standing shell; None where commands of that kind need none.

        Raises:
            EOFError: The link is not connected.
        """
        with self._lock:
            if self._silence_s():
                return
            link.replenish()
            if standing is not None:
                self.standing.restore(link, standing)

    @contextmanager
    def silence(self, seconds: float) -> Iterator[None]:
        """See `Shell.silence`; a link that still lives is not given up either, as that takes packets too.

        What is being opened for commands to come is awaited first.
        """
        if not self._on_air:
            yield
            return
        link = self._link
        try:
            with ExitStack() as measured:
                with self._no_opening(self._timing.reply_s) as within:
                    if link is not None:
                        link.settle(within)
                        self.standing.settle(within)
                    measured.enter_context(self._no_opening(seconds))
                self._endure(link, max(seconds, self._silence_s()))
                yield
        finally:
            self._endure(link, self._silence_s())

    @contextmanager
    def _no_opening(self, seconds: float) -> Iterator[Deadline]:
        """Let nothing be opened or connected during the body, for `seconds` at most.

        Several steps may measure at the same time: it lasts as long as the last of them.
        """
        until = Deadline.after(seconds)
        with self._lock:
            self._silences.append(until)
        try:
            yield until
        finally:
            with self._lock:
                self._silences = [silence for silence in self._silences if silence is not until]

    def _endure(self, link: Link | None, seconds: float) -> None:
        if link is not None:
            with suppress(*BROKEN):  # who uses it next is told
                link.endure(seconds)

    def _silence_s(self) -> float:
        """Return for how long no link, channel or standing shell may be opened, 0 where they may."""
        return max((silence.remaining_s for silence in self._silences), default=0.0)

    def close(self) -> None:
        """End the link, and all waiting for it in other threads."""
        with self._lock:
            self._ended.set()
            self._ended = threading.Event()
            link, self._link = self._link, None
            self._was_up, self._lost_at_s, self._silences = False, None, []
        if link is not None:
            link.close()
