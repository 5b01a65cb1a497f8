"""Answers the requests of a coordinator on behalf of a federate.

A federate is a physics or network simulator. The coordinator is the process of fieldkit that runs the co-simulation.
"""

import copy
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

from sim_backends.federates.agent_states import AgentTable
from sim_backends.federates.channels import ClosedError, DeadlineError, FrameChannel
from sim_backends.federates.exchanges import (
    AdvanceNetwork,
    NetworkOutcomes,
    decode_advance_physics,
    decode_fork,
    decode_number,
    encode_number,
    encode_states,
)
from sim_backends.federates.frames import (
    COPY_POSITION,
    HEADER_BYTES,
    KIND_POSITION,
    MAX_HELLO_BYTES,
    MAX_TEXT_BYTES,
    NETWORK,
    PHYSICS,
    ROLES,
    MalformedFrameError,
    MessageKind,
    ProtocolFrame,
    encode,
    text_bytes,
)
from sim_backends.federates.handshake import NO_EVENT, FederateCapability, Hello, Welcome
from sim_backends.federates.records import COMMAND_TYPES, command_type
from sim_backends.federates.transports.contract import TOKEN_VARIABLE, is_same_token
from sim_backends.world.dead_reckoning import DeadReckoned

_MAX_COPIES: Final = 1000
"""Largest number of copies of a federate in one run."""

MakeFederate = Callable[[Hello], Any]


@dataclass(frozen=True)
class FederateService:
    """A federate and its properties.

    Attributes:
        make: Creates the physics or network federate of a run.
        name: Its name in messages.
        software: Name and version of its software.
        is_deterministic: True if equal requests give equal answers.
        forks: True if `copy.deepcopy` copies it in its current state.
        agents_appear: True if agents may appear during a run.
        agents_disappear: True if agents may disappear.
        commands: Types of commands that it supports.
        transports: Transports that it supports; empty for any.
    """

    make: MakeFederate
    name: str = ""
    software: str = ""
    is_deterministic: bool = True
    forks: bool = True
    agents_appear: bool = False
    agents_disappear: bool = False
    commands: Sequence[int] = COMMAND_TYPES
    transports: Sequence[str] = ()

    def welcome(self, federate: Any, hello: Hello) -> Welcome:  # noqa: ANN401 (a physics or network federate)
        """Return the answer to a hello.

        Raises:
            ValueError: The federate has another role than the coordinator expects.
        """
        role = PHYSICS if hasattr(federate, "step_ns") else NETWORK
        if role != hello.role:
            raise ValueError(f"it is a {ROLES[role]} federate, but a {ROLES[hello.role]} federate was requested")
        flags = {
            FederateCapability.DETERMINISTIC: self.is_deterministic,
            FederateCapability.FORK: self.forks,
            FederateCapability.NEXT_EVENT: hasattr(federate, "next_event_ns"),
            FederateCapability.EXTRAPOLATES: getattr(federate, "extrapolates", False),
            FederateCapability.AGENTS_APPEAR: self.agents_appear,
            FederateCapability.AGENTS_DISAPPEAR: self.agents_disappear,
        }
        indices = AgentTable(agent.name for agent in hello.agents).indices
        return Welcome(
            role,
            self.name or type(federate).__name__,
            hello.configuration_hash,
            self.software,
            FederateCapability(sum(flag for flag, is_set in flags.items() if is_set)),
            federate.step_ns if role == PHYSICS else 0,
            _next_event_ns(federate),
            self.commands if role == PHYSICS else (),
            self.transports if role == NETWORK else (),
            [indices[name] for name in sorted(getattr(federate, "transmitters", ()))],
            tuple(getattr(federate, "fixed_emitters_m", ())),
        )


def _next_event_ns(federate: Any) -> int:  # noqa: ANN401 (a physics or network federate)
    if not hasattr(federate, "next_event_ns"):
        return NO_EVENT
    at_ns = federate.next_event_ns()
    return NO_EVENT if at_ns is None else int(at_ns)


@dataclass
class _FederateCopy:
    """The federate or a copy of it, with its agents and the last time to which it has advanced."""

    federate: Any
    agents: AgentTable
    last_ns: int = 0


class _Heartbeat:
    """Sends `busy` at an interval while a request is computed.

    Args:
        channel: The channel.
        interval_s: Interval between two of these messages.
    """

    def __init__(self, channel: FrameChannel, interval_s: float) -> None:
        self._channel = channel
        self._interval_s = interval_s
        self._lock = threading.Lock()
        self._request: tuple[int, int, int] | None = None
        self._stopped = threading.Event()
        threading.Thread(target=self._run, daemon=True).start()

    def begin(self, request: int, copy_number: int, at_ns: int) -> None:
        """Begin to send `busy` for a request; `at_ns` is the simulated time that the federate has reached."""
        self._request = request, copy_number, at_ns

    def answer(self, frame: bytes) -> None:
        """Send the answer to the request, and no further `busy` for it."""
        with self._lock:
            self._request = None
            self._channel.send(frame, None)

    def stop(self) -> None:
        """Send no more heartbeats."""
        with self._lock:
            self._stopped.set()

    def _run(self) -> None:
        previous = None
        while not self._stopped.wait(self._interval_s):
            with self._lock, suppress(ClosedError):
                current_request = self._request
                # A request that was already current at the previous tick has lasted for at least one interval.
                if current_request is not None and current_request is previous and not self._stopped.is_set():
                    request, copy_number, at_ns = current_request
                    self._channel.send(encode(MessageKind.BUSY, request, copy_number, encode_number(at_ns)), None)
                previous = current_request


@dataclass
class _Run:
    """One run of a coordinator with a federate.

    Attributes:
        service: The federate.
        channel: The channel to the coordinator.
        token: Token that the coordinator must send.
        hello_s: Timeout of the first message of the coordinator, in seconds; None for no limit.
        copies: The federate (number 0) and its copies, by number.
        heartbeat: Sends `busy`; None until a hello with the right token has arrived.
    """

    service: FederateService
    channel: FrameChannel
    token: str
    hello_s: float | None = None
    copies: dict[int, _FederateCopy] = field(default_factory=dict)
    heartbeat: _Heartbeat | None = None

    def serve(self) -> bool:
        """Answer requests until the coordinator ends the run; return True if there was no error."""
        try:
            deadline_s = None if self.hello_s is None else time.monotonic() + self.hello_s
            frame = self.channel.receive(deadline_s, MAX_HELLO_BYTES)
            while frame.header.kind is not MessageKind.BYE:
                if not self._handle(frame):
                    return False
                frame = self.channel.receive(None)
        except ClosedError:
            pass
        except (DeadlineError, MalformedFrameError) as error:
            print(f"a connection was closed: {error}", file=sys.stderr)  # noqa: T201 (stderr is its log)
            return False
        finally:
            if self.heartbeat is not None:
                self.heartbeat.stop()
        return True

    def _handle(self, frame: ProtocolFrame) -> bool:
        """Handle a message, and send the answer; return False if the session must end because of an error."""
        _, kind, request, copy_number = frame.header
        if kind is MessageKind.RELEASE:
            self.copies.pop(copy_number, None)
            return True
        try:
            answer_kind, body = self._answer(frame)
            answer_frame = encode(answer_kind, request, copy_number, body)
        except Exception as error:  # noqa: BLE001 (every error is reported to the coordinator)
            traceback.print_exc()
            text = f"{type(error).__name__}: {error}".encode(errors="replace")[:MAX_TEXT_BYTES]
            self._send(encode(MessageKind.ERROR, request, copy_number, text_bytes(text.decode(errors="ignore"))))
            return False
        self._send(answer_frame)
        return True

    def _send(self, frame: bytes) -> None:
        if self.heartbeat is None:
            self.channel.send(frame, None)
        else:
            self.heartbeat.answer(frame)

    def _answer(self, frame: ProtocolFrame) -> tuple[MessageKind, bytes]:
        """Return kind and body of the answer to a request.

        Raises:
            Exception: The request is malformed, or the federate failed.
        """
        header, body = frame
        if header.kind is MessageKind.HELLO and not self.copies:
            return MessageKind.WELCOME, self._begin(Hello.decode(body), header.request)
        if header.kind is MessageKind.PING:
            return MessageKind.PONG, encode_number(decode_number(body))
        federate_copy = self.copies.get(header.copy)
        if federate_copy is None:
            raise MalformedFrameError(COPY_POSITION, f"there is no copy {header.copy}, or hello is missing")
        if self.heartbeat is not None:
            self.heartbeat.begin(header.request, header.copy, federate_copy.last_ns)
        if header.kind is MessageKind.ADVANCE_PHYSICS and hasattr(federate_copy.federate, "step_ns"):
            return MessageKind.STATES, self._advance_physics(federate_copy, body)
        if header.kind is MessageKind.ADVANCE_NETWORK and not hasattr(federate_copy.federate, "step_ns"):
            return MessageKind.OUTCOMES, self._advance_network(federate_copy, body)
        if header.kind is MessageKind.FORK and self.service.forks:
            return MessageKind.DONE, self._fork(federate_copy, decode_fork(body))
        raise MalformedFrameError(KIND_POSITION, f"the request {header.kind.name.lower()} is not supported")

    def _begin(self, hello: Hello, request: int) -> bytes:
        """Check the token, create the federate, and return the body of `welcome`."""
        if not is_same_token(hello.token, self.token):
            raise PermissionError(f"the token is wrong; set {TOKEN_VARIABLE} to the same text on both sides")
        self.heartbeat = _Heartbeat(self.channel, max(hello.heartbeat_ms / 1e3, 0.01))
        self.heartbeat.begin(request, 0, 0)
        federate = self.service.make(hello)
        self.copies[0] = _FederateCopy(federate, AgentTable(agent.name for agent in hello.agents))
        return self.service.welcome(federate, hello).encode()

    def _advance_physics(self, federate_copy: _FederateCopy, body: bytes) -> bytes:
        to_ns, from_ns, commands = decode_advance_physics(body, federate_copy.agents)
        for name, command in commands.items():
            if command_type(command) not in self.service.commands:
                raise ValueError(f"the command {type(command).__name__} to {name} is not supported")
        federate = federate_copy.federate
        if from_ns > federate_copy.last_ns:
            # The coordinator omits requests that change nothing. The federate first advances to the time of the last
            # omitted request.
            federate.advance(from_ns, {})
        states = federate.advance(to_ns, commands)
        federate_copy.last_ns = to_ns
        return encode_states(to_ns - to_ns % federate.step_ns, states, federate_copy.agents, federate.limits_m_s2)

    def _advance_network(self, federate_copy: _FederateCopy, body: bytes) -> bytes:
        request = AdvanceNetwork.decode(body, federate_copy.agents)
        for packet in request.packets:
            if self.service.transports and packet.protocol not in self.service.transports:
                raise ValueError(f"the transport {packet.protocol} is not supported")
        states = request.states
        if request.reckoning_ns:
            states = DeadReckoned(states, request.since_ns, request.reckoning_ns)
        arrivals, drops = federate_copy.federate.advance(request.to_ns, request.packets, states)
        federate_copy.last_ns = request.to_ns
        return NetworkOutcomes(request.to_ns, _next_event_ns(federate_copy.federate), arrivals, drops).encode(
            federate_copy.agents
        )

    def _fork(self, federate_copy: _FederateCopy, number: int) -> bytes:
        """Copy the federate in its current state."""
        if number in self.copies or len(self.copies) > _MAX_COPIES:
            raise MalformedFrameError(HEADER_BYTES, f"copy {number} already exists, or there are too many copies")
        self.copies[number] = _FederateCopy(
            copy.deepcopy(federate_copy.federate), federate_copy.agents.copy(), federate_copy.last_ns
        )
        return b""


def serve_channel(
    channel: FrameChannel, service: FederateService, token: str = "", hello_s: float | None = None
) -> bool:
    """Serve one run over a channel; return True if it ended without an error.

    Args:
        channel: The channel.
        service: The federate.
        token: Token that the coordinator must send.
        hello_s: Timeout of the first message of the coordinator, in seconds; None for no limit.
    """
    return _Run(service, channel, token, hello_s).serve()
