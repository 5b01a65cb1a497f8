"""The coordinator's side of a connection to an external federate: handshake, requests, deadlines, errors.

A federate is a physics or network simulator. The coordinator is the process of fieldkit that runs the co-simulation.
"""

import re
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import replace
from typing import Final, NoReturn, TypeVar

from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.channels import ClosedError, DeadlineError, FrameChannel
from sim_backends.federates.children import Child
from sim_backends.federates.exchanges import decode_number, decode_text
from sim_backends.federates.frames import (
    KIND_POSITION,
    REQUEST_POSITION,
    ROLES,
    Header,
    MalformedFrameError,
    MessageKind,
    ProtocolFrame,
    UnknownKindError,
    encode,
)
from sim_backends.federates.handshake import Hello, Welcome
from sim_backends.federates.named import command_line, is_single_threaded
from sim_backends.federates.processor_sharing import ProcessorSharing
from sim_backends.federates.protocols import FederateError, UnansweredError, seconds_text
from sim_backends.federates.transports.contract import read_token
from sim_backends.federates.transports.joining import accept_federate
from sim_backends.federates.transports.transport_table import FORMS, parse_address

BUSY_DEADLINE_FACTOR: Final = 20
"""A federate that sends `busy` may take this multiple of the deadline for an answer."""
_FOREVER_S: Final = 1e9
"""Value that replaces a deadline of None: about 30 years."""
_BYE_S: Final = 0.2
"""Longest wait until `bye` is sent."""
_MAX_SHOWN: Final = 400
"""Largest number of characters of a federate's text in a message."""
_REQUEST_NUMBERS: Final = 1 << 32
"""Number of different request numbers, which have 32 bits; the number after the last one is 0."""
_ADDRESS_PATTERN: Final = re.compile(r"[a-z][a-z0-9+.-]*:\S*")

Answer = TypeVar("Answer")


def printable(text: str) -> str:
    """Return a text of a federate in a form for messages: one line, no control characters, limited length."""
    line = "".join(character if character.isprintable() else " " for character in text)
    return line if len(line) <= _MAX_SHOWN else f"{line[:_MAX_SHOWN]}..."


class FederateSession:
    """A connection to an external federate. After a FederateError it is closed, and the child process has exited.

    Args:
        role: `PHYSICS` or `NETWORK`.
        endpoint: The federate's command or address, for messages.
        channel: The channel.
        deadline_s: Longest wait for a frame, in seconds of wall time; None for no deadline.
        child: The process of the federate; None if this process has not started it.

    Attributes:
        name: The federate's role, its name if it has sent one, and its command or address.
        reached_ns: Last simulated time to which the federate has advanced, or None.
        observer: Called with the request and None when a request is sent, and with the request and the answer when
            the answer arrives; None for no observer.
        exchange_context: Context of each request and its answer.
    """

    def __init__(
        self, role: int, endpoint: str, channel: FrameChannel, *, deadline_s: float | None, child: Child | None = None
    ) -> None:
        self._role = role
        self._endpoint = endpoint
        self._channel = channel
        self._child = child
        self._deadline_s = _FOREVER_S if deadline_s is None else deadline_s
        self._request_number = 0
        self._copies = 0
        self._released_copies: list[int] = []
        self._busy_ns: int | None = None
        self._final_limit_s = 0.0
        self._is_closed = False
        self.name = f"{ROLES[role]} ({endpoint})"
        self.reached_ns: int | None = None
        self.observer: Callable[[bytes, ProtocolFrame | None], None] | None = None
        self.exchange_context: AbstractContextManager[None] = nullcontext()

    def __deepcopy__(self, memo: dict[int, object]) -> "FederateSession":
        return self  # copies of a federate share the connection

    def next_copy(self) -> int:
        """Return the number of a new copy of the federate."""
        self._copies += 1
        return self._copies

    def release(self, copy: int) -> None:
        """Release a copy of the federate; the message is sent before the next request."""
        self._released_copies.append(copy)

    def welcome(self, hello: Hello) -> Welcome:
        """Send hello, and return the federate's welcome.

        The notes that a child process has written to its standard error until then are shown.

        Raises:
            FederateError: The federate failed, did not answer, or is not compatible; the message names it.
            ValueError: The hello is too large.
        """
        request_text = f"begin a run as {ROLES[self._role]}"
        welcome = self.request(
            MessageKind.HELLO,
            0,
            hello.encode(),
            MessageKind.WELCOME,
            decode=Welcome.decode,
            describe=lambda: request_text,
        )
        if welcome.name:
            self.name = f"{ROLES[self._role]} {printable(welcome.name)} ({self._endpoint})"
        if welcome.role != self._role:
            self.fail(f"{self.name} is a {ROLES[welcome.role]} federate")
        if welcome.configuration_hash != hello.configuration_hash:
            self.fail(f"{self.name} answered with the hash of another configuration")
        for note in self._child.first_notes() if self._child else ():
            sys.stderr.write(f"note: {self.name}: {printable(note)}\n")
        return welcome

    def request(
        self,
        kind: MessageKind,
        copy: int,
        body: bytes,
        answer_kind: MessageKind,
        *,
        decode: Callable[[bytes], Answer],
        describe: Callable[[], str],
    ) -> Answer:
        """Send a request, and return its decoded answer.

        Args:
            kind: Kind of the request.
            copy: Copy of the federate.
            body: Body of the request.
            answer_kind: Kind of the answer.
            decode: Decodes the body of the answer.
            describe: Returns a description of the request, for error messages.

        Raises:
            UnansweredError: The federate did not answer within its deadline.
            FederateError: The federate failed, closed the connection, or sent a malformed frame.
        """
        if self._is_closed:
            raise FederateError(f"the connection to {self.name} is closed")
        self._busy_ns = None
        try:
            for number in self._released_copies:
                self._channel.send(encode(MessageKind.RELEASE, 0, number), time.monotonic() + self._deadline_s)
            self._released_copies.clear()
            self._request_number = (self._request_number + 1) % _REQUEST_NUMBERS
            expected_header = Header(0, answer_kind, self._request_number, copy)
            with self.exchange_context:
                frame = self._exchange(encode(kind, self._request_number, copy, body), expected_header)
            if frame.header.kind is MessageKind.ERROR:
                text = printable(decode_text(frame.body))
                self.fail(f"{self.name} failed at the request to {describe()}: {text}")
            return decode(frame.body)
        except MalformedFrameError as error:
            is_text = isinstance(error, UnknownKindError) and self._child is not None
            self.fail(
                f"{self.name} answered request {self._request_number}, to {describe()}, with a malformed frame: "
                f"{error}",
                "standard output carries only frames; print to standard error"
                if is_text
                else "compare it with the protocol: fieldkit docs federates",
            )
        except DeadlineError:
            self._fail_unanswered(describe())
        except ClosedError as error:
            self.fail(
                f"{self.name} failed at the request to {describe()}: {error}{self._progress()}{self._exit_text()}"
            )

    def _exchange(self, request: bytes, expected_header: Header) -> ProtocolFrame:
        """Send a request, and return the answer or the error; each `busy` message extends the wait for it."""
        start_s = time.monotonic()
        limit_s, self._final_limit_s = start_s + self._deadline_s, start_s + BUSY_DEADLINE_FACTOR * self._deadline_s
        if self.observer is not None:
            self.observer(request, None)
        self._channel.send(request, limit_s)
        while True:
            frame = self._channel.receive(limit_s)
            _, kind, number, copy = frame.header
            if kind is MessageKind.BUSY:
                if number == expected_header.request:  # otherwise it belongs to an earlier request
                    self._busy_ns = decode_number(frame.body)
                    limit_s = min(time.monotonic() + self._deadline_s, self._final_limit_s)
                continue
            if self.observer is not None:
                self.observer(request, frame)
            if number != expected_header.request or copy != expected_header.copy:
                raise MalformedFrameError(
                    REQUEST_POSITION,
                    f"it is for request {number} and copy {copy}, not {expected_header.request} and "
                    f"{expected_header.copy}",
                )
            if kind is not expected_header.kind and kind is not MessageKind.ERROR:
                raise MalformedFrameError(
                    KIND_POSITION, f"it is {kind.name.lower()}, not {expected_header.kind.name.lower()}"
                )
            return frame

    def fail(self, message: str, remedy: str = "") -> NoReturn:
        """Close the session, kill the child process, and raise an error.

        Raises:
            FederateError: Always.
        """
        error = FederateError(message, remedy=remedy)
        self._end()
        raise error

    def _fail_unanswered(self, request_text: str) -> NoReturn:
        failure, limit_s, busy_text = "has not answered", self._deadline_s, ""
        if self._busy_ns is not None:
            busy_text = f"; it last reported {seconds_text(self._busy_ns)}"
            if time.monotonic() < self._final_limit_s:
                failure = "has sent neither an answer nor a heartbeat"
            else:
                limit_s *= BUSY_DEADLINE_FACTOR
        error = UnansweredError(
            f"{self.name} {failure} for {limit_s:g} s: request to {request_text}{self._progress()}{busy_text}"
            f"{self._output_text()}",
            remedy="find out why it waits, or set a longer deadline",
        )
        self._end()
        raise error

    def _progress(self) -> str:
        return "" if self.reached_ns is None else f"; its last time is {seconds_text(self.reached_ns)}"

    def _exit_text(self) -> str:
        if self._child is None:
            return ""
        exit_text = self._child.exit_text()
        return (f"; {exit_text}" if exit_text else "") + self._output_text()

    def _output_text(self) -> str:
        lines = [] if self._child is None else [printable(line) for line in self._child.last_output]
        if len(lines) < 2:
            return "".join(f"; its last output: {line.strip()}" for line in lines)
        return "".join(("; its last output:", *(f"\n    {line}" for line in lines)))

    def _end(self) -> None:
        self._is_closed = True
        if self._child is not None:
            self._child.kill()
        self._channel.close()

    def send_bye(self, limit_s: float) -> None:
        """End the session, and wait until the federate closes the connection.

        Args:
            limit_s: Longest wait, in seconds of wall time.

        Raises:
            ClosedError: The federate has closed the connection.
            DeadlineError: The connection is still open at the limit.
        """
        deadline_s = time.monotonic() + limit_s
        self._channel.send(encode(MessageKind.BYE, 0, 0), deadline_s)
        while True:
            self._channel.receive(deadline_s)

    def close(self) -> None:
        """End the session, and stop the child process; a second call has no effect."""
        if self._is_closed:
            return
        self._is_closed = True
        with suppress(ClosedError, DeadlineError):
            self._channel.send(encode(MessageKind.BYE, 0, 0), time.monotonic() + _BYE_S)
        if self._child is not None:
            self._child.close()
        self._channel.close()


def _child(endpoint: str, role: int) -> Child:
    """Start a federate by its name or its command.

    Raises:
        ConfigurationError: The federate cannot be started; `endpoint` may be an address of an unknown transport.
    """
    command = command_line(endpoint, role)
    try:
        return Child(command)
    except ConfigurationError as error:
        if not _ADDRESS_PATTERN.fullmatch(endpoint):
            raise
        raise ConfigurationError(
            f"{endpoint!r} is not an address, and there is no program with this name",
            remedy=f"use {', '.join(FORMS)}, or a command, for example 'python3 carts.py'",
        ) from error


def open_session(
    role: int, endpoint: str, hello: Hello, deadline_s: float | None
) -> tuple[FederateSession, Hello, Welcome]:
    """Start or connect to a federate, and return its session with both messages of the handshake.

    Args:
        role: `PHYSICS` or `NETWORK`.
        endpoint: A name, a command, or an address of a transport (`transports.transport_table`).
        hello: The hello that the federate receives; the token is added if `endpoint` is an address, and the interval
            of heartbeats is limited to a quarter of the deadline.
        deadline_s: Longest wait for the connection and for each frame; None for no deadline.

    Raises:
        ConfigurationError: The name, the command or the address cannot be used, or the hello is too large.
        FederateError: The federate failed, or has not connected or answered in time.
    """
    address = parse_address(endpoint)
    if deadline_s is not None:
        # There are several heartbeats per deadline, because the federate's machine may be busy.
        hello = replace(hello, heartbeat_ms=max(min(hello.heartbeat_ms, round(deadline_s * 250)), 1))
    if address is None:
        child = _child(endpoint, role)
        session = FederateSession(role, printable(endpoint), child.channel, deadline_s=deadline_s, child=child)
        if is_single_threaded(endpoint, role):
            session.exchange_context = ProcessorSharing(child.pid)
    else:
        token = read_token(address)
        hello = replace(hello, token=token)
        limit_s = time.monotonic() + (_FOREVER_S if deadline_s is None else deadline_s)
        try:
            channel = accept_federate(address, token, limit_s) if address.listens else address.connect(limit_s)
        except DeadlineError as error:
            preposition = "for" if address.listens is False else "within"
            raise UnansweredError(
                f"{ROLES[role]} ({address}): {error} {preposition} {deadline_s:g} s",
                remedy="start the federate, or check its address and token",
            ) from error
        session = FederateSession(role, str(address), channel, deadline_s=deadline_s)
    try:
        return session, hello, session.welcome(hello)
    except ValueError as error:
        session.close()
        raise ConfigurationError(f"{session.name}: {error}") from error
    except BaseException:
        session.close()
        raise
