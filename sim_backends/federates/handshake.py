"""The handshake of the wire protocol: join, hello, welcome (docs/federates.md)."""

import hashlib
import json
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntFlag
from typing import Any, Final

from fieldkit.core.model import Vector
from fieldkit.core.units import parse_duration_s
from sim_backends.federates.agent_states import STATE, AgentTable, read_states, states_bytes
from sim_backends.federates.frames import (
    MAGIC,
    MAX_AGENTS,
    MAX_HELLO_BYTES,
    PHYSICS,
    ROLES,
    VERSION,
    FrameReader,
    MalformedFrameError,
    count_bytes,
    short_count_bytes,
    text_bytes,
)
from sim_backends.world.motion import Lifetime, State

NO_EVENT: Final = -1
"""Value of the time of the next event if there is no next event."""
_PREFIX: Final = struct.Struct("<8sH")
_HELLO: Final = struct.Struct("<BBIQqq32s")
_WELCOME: Final = struct.Struct("<HBBIqq32s")
_AGENT: Final = struct.Struct("<Bd")
_U16: Final = struct.Struct("<H")
_U32: Final = struct.Struct("<I")
_POSITION: Final = struct.Struct("<3d")
_AGENT_BYTES: Final = 4 + _AGENT.size + STATE.size
"""Smallest size of an agent in hello; its two texts have at least their lengths, 2 bytes each."""


class FederateCapability(IntFlag):
    """Optional properties of a federate.

    Attributes:
        DETERMINISTIC: Equal requests give equal answers.
        FORK: It can be copied in its current state.
        NEXT_EVENT: Before `next_event_ns`, no packet arrives or is dropped and no position is used, unless a new
            packet enters. The time may be earlier than the event; -1: there is no event.
        EXTRAPOLATES: It moves agents by dead reckoning.
        AGENTS_APPEAR: Agents that are not in hello may appear.
        AGENTS_DISAPPEAR: Agents may disappear, and return.
        SAMPLES_LINKS: It answers requests for samples of the links of its radios.
    """

    DETERMINISTIC = 1
    FORK = 2
    NEXT_EVENT = 4
    EXTRAPOLATES = 8
    AGENTS_APPEAR = 16
    AGENTS_DISAPPEAR = 32
    SAMPLES_LINKS = 64


NO_CAPABILITY: Final = FederateCapability(0)


def _read_prefix(reader: FrameReader) -> None:
    magic, version = reader.unpack(_PREFIX)
    if magic != MAGIC:
        raise MalformedFrameError(reader.position - 10, "this is not fieldkit's protocol for federates")
    if version != VERSION:
        raise MalformedFrameError(reader.position - 2, f"protocol version {version}; this program supports {VERSION}")


def encode_join(token: str) -> bytes:
    """Return the body of `join`. Raises ValueError if the token is too long."""
    return _PREFIX.pack(MAGIC, VERSION) + text_bytes(token)


def decode_join(body: bytes) -> str:
    """Return the token of `join`.

    Raises:
        MalformedFrameError: The body is malformed, or has another protocol version.
    """
    reader = FrameReader(body)
    _read_prefix(reader)
    token = reader.text()
    reader.check_end()
    return token


@dataclass(frozen=True)
class AgentStart:
    """An agent at the beginning of a run.

    Attributes:
        name: Its name.
        profile: Kind of robot: a robot profile or a built-in body.
        start: State of its antenna at time 0.
        flies: True if it flies.
        antenna_m: Height of the antenna above the body's position.
        limit_m_s2: Largest change of its velocity per second; infinity if it is unknown.
    """

    name: str
    profile: str
    start: State
    flies: bool = False
    antenna_m: float = 0.0
    limit_m_s2: float = math.inf


_LIFETIME_KEYS: Final = ("appears", "disappears")


@dataclass(frozen=True)
class Hello:
    """The first message to a federate: the run, its agents and its configuration.

    Attributes:
        role: `PHYSICS` or `NETWORK`.
        agents: The agents at the beginning, in the order of their indices.
        seed: Seed of all random draws.
        step_ns: Physics step that the scenario requests.
        end_ns: End of the run.
        name: Name of the scenario.
        configuration: JSON with scenario, world, robots and options.
        heartbeat_ms: Interval at which a federate sends `busy` while it computes.
        token: Token of a connection between machines.
    """

    role: int
    agents: Sequence[AgentStart]
    seed: int = 1
    step_ns: int = 1_000_000
    end_ns: int = 0
    name: str = ""
    configuration: bytes = b"{}"
    heartbeat_ms: int = 1000
    token: str = field(default="", repr=False)

    @property
    def configuration_hash(self) -> bytes:
        """SHA-256 of the configuration."""
        return hashlib.sha256(self.configuration).digest()

    @property
    def lifetimes(self) -> dict[str, Lifetime]:
        """The lifetimes of agents that do not exist during the whole run, from the configuration."""
        plans = json.loads(self.configuration).get("scenario", {}).get("agents", {})
        times_ns = {
            name: [round(parse_duration_s(plan[key]) * 1e9) if key in plan else None for key in _LIFETIME_KEYS]
            for name, plan in plans.items()
        }
        lifetimes = {name: Lifetime(appears or 0, disappears) for name, (appears, disappears) in times_ns.items()}
        return {name: lifetime for name, lifetime in lifetimes.items() if lifetime != Lifetime()}

    def encode(self) -> bytes:
        """Return the body of the message.

        Raises:
            ValueError: A number, a text or the whole message is too large, or there are too many agents.
        """
        table = AgentTable(agent.name for agent in self.agents)
        try:
            numbers = (self.role, 0, self.heartbeat_ms, self.seed, self.step_ns, self.end_ns)
            parts = [_PREFIX.pack(MAGIC, VERSION), _HELLO.pack(*numbers, self.configuration_hash)]
        except struct.error as error:
            raise ValueError(f"a number of the run is too large for an external federate: {error}") from error
        parts += [text_bytes(self.token), text_bytes(self.name), count_bytes(len(self.agents))]
        for agent in self.agents:
            start = states_bytes({agent.name: agent.start}, table, {agent.name: agent.limit_m_s2})
            parts += [
                text_bytes(agent.name),
                text_bytes(agent.profile),
                _AGENT.pack(agent.flies, agent.antenna_m),
                start[_U32.size :],  # without the count of states
            ]
        body = b"".join([*parts, count_bytes(len(self.configuration)), self.configuration])
        if len(body) > MAX_HELLO_BYTES or len(self.agents) > MAX_AGENTS:
            raise ValueError(
                f"a hello of {len(body)} bytes with {len(self.agents)} agents is too large for an external federate "
                f"(limits: {MAX_HELLO_BYTES} bytes, {MAX_AGENTS} agents)"
            )
        return body

    @staticmethod
    def decode(body: bytes) -> "Hello":
        """Return the message of a body.

        Raises:
            MalformedFrameError: The body is malformed, or has another protocol version.
        """
        reader = FrameReader(body)
        _read_prefix(reader)
        role, _, heartbeat_ms, seed, step_ns, end_ns, configuration_hash = reader.unpack(_HELLO)
        if role not in ROLES:
            raise MalformedFrameError(reader.position - _HELLO.size, f"there is no role {role}")
        token, name = reader.text(), reader.text()
        table = AgentTable()
        agents = [_read_agent(reader, table) for _ in range(reader.count(_AGENT_BYTES))]
        position = reader.position
        configuration = reader.read_bytes(reader.count(1))
        reader.check_end()
        hello = Hello(role, agents, seed, step_ns, end_ns, name, configuration, heartbeat_ms, token)
        if configuration_hash != hello.configuration_hash:
            raise MalformedFrameError(position, "the configuration does not have the announced hash")
        return hello


def _read_agent(reader: FrameReader, table: AgentTable) -> AgentStart:
    position = reader.position
    name, profile = reader.text(), reader.text()
    flies, antenna_m = reader.unpack(_AGENT)
    if not name or name in table.indices or len(table.names) >= MAX_AGENTS:
        raise MalformedFrameError(
            position, f"the agent's name {name!r} is empty or not unique, or there are too many agents"
        )
    table.add([name])
    states = read_states(FrameReader(count_bytes(1) + reader.read_bytes(STATE.size)), table)
    if name not in states:
        raise MalformedFrameError(position, f"the start of {name} has the index of another agent")
    return AgentStart(name, profile, states[name], bool(flies), antenna_m, states.limits_m_s2[name])


@dataclass(frozen=True)
class Welcome:
    """A federate's answer to `Hello`.

    Attributes:
        role: Its role.
        name: Its name.
        configuration_hash: The hash of the configuration that it received.
        software: Name and version of its software, for messages and recordings.
        capabilities: Its optional properties.
        step_ns: Its time step; 0 for a network.
        next_event_ns: Time of the first event of a network; `NO_EVENT` if there is none.
        commands: Types of commands that it supports.
        transports: Names of the transports that it supports; empty for any.
        transmitters: Indices of agents that forward or interfere.
        emitters_m: Positions of sources of interference that are not agents.
    """

    role: int
    name: str
    configuration_hash: bytes
    software: str = ""
    capabilities: FederateCapability = NO_CAPABILITY
    step_ns: int = 0
    next_event_ns: int = NO_EVENT
    commands: Sequence[int] = ()
    transports: Sequence[str] = ()
    transmitters: Sequence[int] = ()
    emitters_m: Sequence[Vector] = ()

    def encode(self) -> bytes:
        """Return the body of the message. Raises ValueError if a text is too long."""
        numbers = (VERSION, self.role, 0, self.capabilities, self.step_ns, self.next_event_ns)
        parts = [_WELCOME.pack(*numbers, self.configuration_hash), text_bytes(self.name), text_bytes(self.software)]
        parts += [short_count_bytes(len(self.commands)), *map(_U16.pack, self.commands)]
        parts += [short_count_bytes(len(self.transports)), *map(text_bytes, self.transports)]
        parts += [count_bytes(len(self.transmitters)), *map(_U32.pack, self.transmitters)]
        parts += [count_bytes(len(self.emitters_m)), *(_POSITION.pack(*position) for position in self.emitters_m)]
        return b"".join(parts)

    @staticmethod
    def decode(body: bytes) -> "Welcome":
        """Return the message of a body.

        Raises:
            MalformedFrameError: The body is malformed, or has another protocol version.
        """
        reader = FrameReader(body)
        version, role, _, bits, step_ns, next_event_ns, configuration_hash = reader.unpack(_WELCOME)
        begin = reader.position - _WELCOME.size
        if version != VERSION:
            raise MalformedFrameError(begin, f"protocol version {version}; this program supports {VERSION}")
        if role not in ROLES or (step_ns <= 0 if role == PHYSICS else step_ns < 0):
            raise MalformedFrameError(begin + 2, f"role {role} with a step of {step_ns} ns is invalid")
        name, software = reader.text(), reader.text()
        commands = [reader.unpack(_U16)[0] for _ in range(reader.short_count(2))]
        transports = [reader.text() for _ in range(reader.short_count(2))]
        transmitters = [reader.unpack(_U32)[0] for _ in range(reader.count(4))]
        emitters_m: list[Any] = [reader.unpack(_POSITION) for _ in range(reader.count(24))]
        reader.check_end()
        if not all(math.isfinite(sum(position)) for position in emitters_m):
            raise MalformedFrameError(reader.position, "the position of an emitter is not finite")
        # Bits of capabilities that this version does not have are ignored.
        known_capabilities = FederateCapability(bits & int(~FederateCapability(0)))
        return Welcome(
            role,
            name,
            configuration_hash,
            software,
            known_capabilities,
            step_ns,
            next_event_ns,
            commands,
            transports,
            transmitters,
            emitters_m,
        )
