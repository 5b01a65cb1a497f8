"""Helpers of the conformance checks: they connect to new federates, and record the last request and its answer."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Protocol

from sim_backends.federates.agent_states import AgentTable
from sim_backends.federates.channels import ClosedError, DeadlineError
from sim_backends.federates.exchanges import (
    AdvanceNetwork,
    NetworkOutcomes,
    decode_number,
    decode_states,
    encode_advance_physics,
    encode_fork,
    encode_number,
)
from sim_backends.federates.frames import HEADER_BYTES, PHYSICS, MessageKind, ProtocolFrame
from sim_backends.federates.handshake import FederateCapability, Hello, Welcome
from sim_backends.federates.protocols import FederateError
from sim_backends.federates.session import FederateSession
from sim_backends.network.packets import Packet
from sim_backends.world.motion import State

_SHOWN_BYTES: Final = 120
"""Largest number of bytes in the description of a frame."""
_CLOSE_S: Final = 5.0
"""Longest wait until the federate closes the connection after `bye`."""


class CheckError(Exception):
    """A federate does not conform to the protocol; the message is the reason."""


class NotDeclaredError(Exception):
    """A check does not apply, for example because the federate does not declare a capability; the message is why."""


class Opener(Protocol):
    """Starts or connects to a new federate."""

    def __call__(self, hello: Hello) -> tuple[FederateSession, Hello, Welcome]:
        """Return its session, the hello that was sent, and its answer, like `open_session`."""
        ...


@dataclass(frozen=True)
class PhysicsAnswer:
    """The answer of a physics federate.

    Attributes:
        at_ns: Time of the states.
        states: The states.
        limits_m_s2: Acceleration limit of each agent.
        body: The bytes of the answer.
    """

    at_ns: int
    states: Mapping[str, State]
    limits_m_s2: Mapping[str, float]
    body: bytes


def frame_text(frame: bytes) -> str:
    """Return a description of a frame: its size, and its first bytes in hexadecimal."""
    ellipsis = "" if len(frame) <= _SHOWN_BYTES else "..."
    return f"{len(frame)} bytes: {frame[:_SHOWN_BYTES].hex(' ', 4)}{ellipsis}"


class FederateProbe:
    """A connection to a new federate, without the coordinator's checks of requests and answers.

    Args:
        opener: Starts or connects to it.
        hello: The hello that it receives.
        exchange: The probe stores the last request and its answer in this mapping.

    Attributes:
        hello: The hello that it received.
        welcome: Its answer.
        agents: The agents that were announced.
        last_ns: Time of the last request to advance.
    """

    def __init__(self, opener: Opener, hello: Hello, exchange: dict[str, str]) -> None:
        self._session, self.hello, self.welcome = opener(hello)
        self._exchange = exchange
        self.agents = AgentTable(agent.name for agent in hello.agents)
        self._session.observer = self._observe
        self.last_ns = 0

    def _observe(self, request: bytes, answer: ProtocolFrame | None) -> None:
        self._exchange["request"] = f"{MessageKind(request[4]).name.lower()}, {frame_text(request)}"
        self._exchange["answer"] = "none"
        if answer is not None:
            header = answer.header
            size = HEADER_BYTES + header.size
            self._exchange["answer"] = (
                f"{header.kind.name.lower()} to request {header.request}, {size} bytes; "
                f"after the header {frame_text(answer.body)}"
            )

    def has(self, capability: FederateCapability) -> bool:
        """Return True if the federate declares a capability."""
        return bool(self.welcome.capabilities & capability)

    def require(self, capability: FederateCapability) -> None:
        """Raise `NotDeclaredError` if the federate does not declare a capability."""
        if not self.has(capability):
            raise NotDeclaredError(f"it does not declare {capability.name}")

    def request(
        self,
        kind: MessageKind,
        body: bytes,
        answer_kind: MessageKind,
        decode: Callable[[bytes], Any],
        *,
        copy: int = 0,
    ) -> Any:  # noqa: ANN401 (the result of `decode`)
        """Send a request, and return the decoded answer. Raises the errors of `FederateSession.request`."""
        request_name = kind.name.lower().replace("_", " ")
        return self._session.request(kind, copy, body, answer_kind, decode=decode, describe=lambda: request_name)

    def advance_physics(
        self, to_ns: int, commands: Mapping[str, Any] | None = None, *, from_ns: int | None = None, copy: int = 0
    ) -> PhysicsAnswer:
        """Advance a physics federate; the commands apply from the time of the last call, or from `from_ns`.

        Raises:
            CheckError: Agents appeared or disappeared, but the federate does not declare that they may.
        """
        begin_ns = self.last_ns if from_ns is None else from_ns
        body = encode_advance_physics(to_ns, begin_ns, commands or {}, self.agents)
        names_before = set(self.agents.names)
        decode = partial(_decode_physics_answer, agents=self.agents)
        states_answer: PhysicsAnswer = self.request(
            MessageKind.ADVANCE_PHYSICS, body, MessageKind.STATES, decode, copy=copy
        )
        self.last_ns = to_ns
        if set(self.agents.names) - names_before and not self.has(FederateCapability.AGENTS_APPEAR):
            raise CheckError(f"the agent {self.agents.names[-1]} appeared, but it does not declare AGENTS_APPEAR")
        missing_names = names_before - states_answer.states.keys()
        if missing_names and not self.has(FederateCapability.AGENTS_DISAPPEAR):
            raise CheckError(
                f"there is no state of {', '.join(sorted(missing_names))}, but it does not declare AGENTS_DISAPPEAR"
            )
        return states_answer

    def advance_network(
        self,
        to_ns: int,
        states: Mapping[str, State],
        packets: Sequence[Packet] = (),
        *,
        reckoning_ns: int = 0,
        copy: int = 0,
    ) -> NetworkOutcomes:
        """Advance a network to `to_ns`, and return its answer."""
        body = AdvanceNetwork(to_ns, states, packets, self.last_ns, reckoning_ns).encode(self.agents)
        decode = partial(NetworkOutcomes.decode, agents=self.agents)
        outcomes: NetworkOutcomes = self.request(
            MessageKind.ADVANCE_NETWORK, body, MessageKind.OUTCOMES, decode, copy=copy
        )
        self.last_ns = to_ns
        return outcomes

    def fork(self, copy: int) -> None:
        """Request a copy of the federate in its current state."""
        self.request(MessageKind.FORK, encode_fork(copy), MessageKind.DONE, bytes)

    def ping(self, value: int) -> int:
        """Return the value of the answer to a ping."""
        number: int = self.request(MessageKind.PING, encode_number(value), MessageKind.PONG, decode_number)
        return number

    def expect_error(self, kind: MessageKind, body: bytes, answer_kind: MessageKind, request_text: str) -> None:
        """Send a request that the federate must refuse.

        Raises:
            CheckError: The federate sends another answer, or no answer within the deadline.
        """
        start_s = time.monotonic()
        try:
            self.request(kind, body, answer_kind, bytes)
        except FederateError as error:
            # The federate answered with an error, or closed the connection. A missing answer has another exit code,
            # and a malformed or wrong answer has another message.
            if error.exit_code == 1 and "failed at the request" in error.what:
                return
            raise CheckError(
                f"it must refuse {request_text}: {error.what} ({time.monotonic() - start_s:.1f} s)"
            ) from error
        raise CheckError(f"it must refuse {request_text}, but it answered")

    def end(self) -> None:
        """End the session by `bye`, and wait until the federate closes the connection.

        Raises:
            CheckError: The federate does not close the connection.
        """
        try:
            self._session.send_bye(_CLOSE_S)
        except DeadlineError as error:
            raise CheckError(f"it has not closed the connection {_CLOSE_S:g} s after bye") from error
        except ClosedError:
            pass

    def close(self) -> None:
        """Stop the federate."""
        self._session.close()


def _decode_physics_answer(body: bytes, agents: AgentTable) -> PhysicsAnswer:
    at_ns, states = decode_states(body, agents)
    return PhysicsAnswer(at_ns, states, states.limits_m_s2, body)


@dataclass
class Target:
    """An external federate under test.

    Attributes:
        opener: Starts or connects to it.
        hello: The hello that it receives.
        windows: Number of windows of the check for drift.
        exchange: Descriptions of the last request and of its answer, with the keys `request` and `answer`.
    """

    opener: Opener
    hello: Hello
    windows: int = 2000

    def __post_init__(self) -> None:
        self.exchange: dict[str, str] = {}
        self._probe: FederateProbe | None = None

    @property
    def is_physics(self) -> bool:
        """True if a physics federate is tested."""
        return self.hello.role == PHYSICS

    def open(self, hello: Hello | None = None) -> FederateProbe:
        """Stop the last federate, and return a new one; a listening federate may serve only one run at a time.

        Args:
            hello: The hello that it receives; None for the hello of the target.
        """
        self.close()
        self.exchange |= {"request": "hello", "answer": "none"}
        self._probe = FederateProbe(self.opener, hello or self.hello, self.exchange)
        return self._probe

    def close(self) -> None:
        """Stop the last federate."""
        if self._probe is not None:
            self._probe.close()
            self._probe = None
