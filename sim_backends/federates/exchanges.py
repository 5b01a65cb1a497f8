"""Requests and answers of the wire protocol after the handshake, and the rules for both sides.

Agents have indices from 0 in the order of their announcement, first the agents in `hello`. An agent that appears
later gets the next index in the first message that mentions it. The coordinator can copy a federate by `fork`; an
index is valid in the copy that the message is for, and in copies that are made of this copy later.

- **Handshake.** The coordinator sends hello; the federate answers with welcome or error. `welcome` repeats the
  configuration hash, which is the SHA-256 of `configuration`. `name` is the scenario's name in hello, and the
  federate's name in welcome. The side that accepts a connection checks the token of join or hello.
- **Transports.** Welcome lists the values of a packet's `protocol` that the network carries: `udp`, `tcp`, `topic`,
  `ros1`; an empty list means all. The network refuses others with an error. [Real programs](lab-cosim.md) send
  packets of the transport `ip`, whose size includes the IP header, and `ip-broadcast`: one packet per receiver, with
  equal source, number and time. With the key `network.transports: builtin` the network needs only these two
  transports and the capability *next event*, because fieldkit's UDP, TCP, topics and ROS 1 send IP packets.
- **Configuration.** The JSON has `scenario` (keys as in [a scenario file](reference/scenario-file.md)), `world` ([a
  world file](reference/world-file.md)), `robots` (limits of each agent's body, and its radio) and `options`. A simple
  federate ignores it and uses the agents of hello. If the run has an output folder, a network that is declared with
  `writes_captures` also gets `captures`: the `folder` in which it writes an `AGENT.pcap` of raw IP for each agent;
  `addresses` by agent; and `flows` by name: `port` of the destination (0: the network chooses it), `ping` (identifier
  of ICMP echo; 0: none), `reply` (true: the flow consists of echo replies).
- **Physics: states.** `at_ns` is `to_ns` rounded down to a multiple of the `step_ns` in welcome; the states are valid
  at this time. Positions are of the antenna. `heading_rad` is from east towards north, NaN if undefined. `limit_m_s2`
  is the largest change of velocity per second after this time, infinity if unknown; in requests to a network it has
  no meaning.
- **Physics: requests.** The first `to_ns` is 0; it never decreases. Commands apply in the steps that begin at or
  after `from_ns`, so the states at `from_ns` still have the old velocity. A command applies until the agent gets a
  new one. The coordinator omits a request without commands for a time in the step whose states it already has. The
  federate refuses a type of command that welcome does not list.
- **Network.** It simulates up to and including `to_ns`, and returns each packet exactly once: as an arrival with
  `enters_ns` <= `at_ns` <= `to_ns`, and `at_ns` not before the previous `to_ns`; or as a drop with its reason. Both
  lists are in order of time. `at_ns` of outcomes is `to_ns`. Packets are in order of `enters_ns`, which may equal the
  previous `to_ns`. If the first window has length 0, its `to_ns` is -1. Random draws depend on the seed; derive each
  draw from the seed, `flow` and `number`, so that runs can be compared.
- **Dead reckoning.** If `reckoning_ns` is above 0, which needs the capability *extrapolates*, the position at the
  time t is `position_m` + n `reckoning_ns` / 10^9 `velocity_m_s`, where n is (t - `since_ns`) / `reckoning_ns`,
  rounded down. Otherwise agents stay at their positions until the next request.
- **Absent agents** have no state. A physics federate with the capability *agents disappear* omits agents that it has
  removed; they may return. With the scenario's keys `appears` and `disappears` the coordinator ignores states of
  absent agents, sends them no commands, and drops their packets as `agent absent`; the network still reports the
  fates of packets that it already carries. A network without the capability *agents disappear* receives the last
  states of absent agents, or their start states.
- **Interference.** Transmitters in welcome are agents that forward or interfere; emitters are sources of interference
  that are not agents.
- **Deadlines.** A federate that computes for longer than `heartbeat_ms` sends busy. The coordinator waits 30 s for a
  frame (`--deadline`), and at most 20 times as long for an answer.
- **Malformed frames** end the session; the side that receives one reports the position of the wrong byte.
"""

import struct
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from sim_backends.federates.agent_states import (
    STATE,
    AgentTable,
    ReceivedStates,
    announcements_bytes,
    read_announcements,
    read_states,
    states_bytes,
    unpack_states,
)
from sim_backends.federates.frames import HEADER_BYTES, FrameReader, MalformedFrameError
from sim_backends.federates.records import (
    ArrivalDelay,
    arrival_delays_bytes,
    arrivals_bytes,
    commands_bytes,
    drops_bytes,
    packets_bytes,
    read_arrival_delays,
    read_arrivals,
    read_commands,
    read_drops,
    read_packets,
)
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.motion import State

_TIME: Final = struct.Struct("<q")
_TWO_TIMES: Final = struct.Struct("<qq")
_NO_COMMANDS: Final = struct.Struct("<qqI")
"""A request to a physics federate in which the count of commands is 0."""
_NO_OUTCOMES: Final = struct.Struct("<qqQ")
"""An answer of a network in which both counts are 0."""
_THREE_TIMES: Final = struct.Struct("<qqq")
_U32: Final = struct.Struct("<I")
_STATES_HEAD: Final = struct.Struct("<qII")
"""An answer of a physics federate without new agents: time, 0, number of states."""


def encode_advance_physics(to_ns: int, from_ns: int, commands: Mapping[str, Any], agents: AgentTable) -> bytes:
    """Return the body of a request to a physics federate. Raises the errors of `commands_bytes`.

    Args:
        to_ns: Time to advance to.
        from_ns: Time from which the commands apply.
        commands: Commands by agent.
        agents: The agents.
    """
    if not commands:
        return _NO_COMMANDS.pack(to_ns, from_ns, 0)
    return _TWO_TIMES.pack(to_ns, from_ns) + commands_bytes(commands, agents)


def decode_advance_physics(body: bytes, agents: AgentTable) -> tuple[int, int, dict[str, Twist | Velocity]]:
    """Return `to_ns`, `from_ns` and the commands of a request to a physics federate.

    Raises:
        MalformedFrameError: The body is malformed.
    """
    if len(body) == _NO_COMMANDS.size:
        to_ns, from_ns, count = _NO_COMMANDS.unpack(body)
        if not count:
            return to_ns, from_ns, {}
    reader = FrameReader(body)
    to_ns, from_ns = reader.unpack(_TWO_TIMES)
    commands = read_commands(reader, agents)
    reader.check_end()
    return to_ns, from_ns, commands


def encode_states(
    at_ns: int, states: Mapping[str, State], agents: AgentTable, limits_m_s2: Mapping[str, float]
) -> bytes:
    """Return the body of a physics federate's answer. Raises the errors of `announcements_bytes`."""
    return _TIME.pack(at_ns) + announcements_bytes(states, agents) + states_bytes(states, agents, limits_m_s2)


def decode_states(body: bytes, agents: AgentTable) -> tuple[int, ReceivedStates]:
    """Return time and states of a physics federate's answer; the states include the acceleration limits.

    Raises:
        MalformedFrameError: The body is malformed.
    """
    if len(body) >= _STATES_HEAD.size:
        at_ns, new_count, count = _STATES_HEAD.unpack_from(body)
        if not new_count and len(body) == _STATES_HEAD.size + count * STATE.size:
            return at_ns, unpack_states(body[_STATES_HEAD.size :], HEADER_BYTES + _STATES_HEAD.size, agents)
    reader = FrameReader(body)
    (at_ns,) = reader.unpack(_TIME)
    read_announcements(reader, agents)
    states = read_states(reader, agents)
    reader.check_end()
    return at_ns, states


class AdvanceNetwork(NamedTuple):
    """A request to a network.

    Attributes:
        to_ns: Time to advance to.
        states: States of the agents.
        packets: Packets that enter.
        since_ns: Time of the states; only dead reckoning uses it.
        reckoning_ns: Step of dead reckoning; 0 if agents do not move until the next request.
    """

    to_ns: int
    states: Mapping[str, State]
    packets: Sequence[Packet]
    since_ns: int = 0
    reckoning_ns: int = 0

    def encode(self, agents: AgentTable) -> bytes:
        """Return the body of the message.

        Raises:
            ValueError: There are too many agents, or a text is too long.
        """
        return b"".join(
            (
                _THREE_TIMES.pack(self.to_ns, self.since_ns, self.reckoning_ns),
                announcements_bytes(self.states, agents),
                states_bytes(self.states, agents, None),
                packets_bytes(self.packets, agents),
            )
        )

    @staticmethod
    def decode(body: bytes, agents: AgentTable) -> "AdvanceNetwork":
        """Return the message of a body.

        Raises:
            MalformedFrameError: The body is malformed.
        """
        reader = FrameReader(body)
        to_ns, since_ns, reckoning_ns = reader.unpack(_THREE_TIMES)
        if reckoning_ns < 0:
            raise MalformedFrameError(reader.position - 8, f"a step of {reckoning_ns} ns is negative")
        read_announcements(reader, agents)
        states = read_states(reader, agents)
        packets = read_packets(reader, agents)
        reader.check_end()
        return AdvanceNetwork(to_ns, states, packets, since_ns, reckoning_ns)


class NetworkOutcomes(NamedTuple):
    """A network's answer.

    Attributes:
        at_ns: Time that it has reached.
        next_event_ns: Time of its next event; `NO_EVENT` if there is none.
        arrivals: Packets that arrived.
        drops: Packets that will never arrive.
        delays: Parts of the delay of each arrival; empty if the network does not report them.
    """

    at_ns: int
    next_event_ns: int
    arrivals: Sequence[Arrival]
    drops: Sequence[Drop]
    delays: Sequence[ArrivalDelay] = ()

    def encode(self, agents: AgentTable) -> bytes:
        """Return the body of the message. Raises ValueError if a reason of a drop is too long."""
        return (
            _TWO_TIMES.pack(self.at_ns, self.next_event_ns)
            + arrivals_bytes(self.arrivals, agents)
            + drops_bytes(self.drops)
            + arrival_delays_bytes(self.delays)
        )

    @staticmethod
    def decode(body: bytes, agents: AgentTable) -> "NetworkOutcomes":
        """Return the message of a body.

        Raises:
            MalformedFrameError: The body is malformed.
        """
        if len(body) == _NO_OUTCOMES.size:
            at_ns, next_event_ns, both_counts = _NO_OUTCOMES.unpack(body)
            if not both_counts:
                return NetworkOutcomes(at_ns, next_event_ns, (), ())
        reader = FrameReader(body)
        at_ns, next_event_ns = reader.unpack(_TWO_TIMES)
        arrivals, drops = read_arrivals(reader, agents), read_drops(reader)
        delays = read_arrival_delays(reader, len(arrivals)) if reader.remaining_bytes else ()
        reader.check_end()
        return NetworkOutcomes(at_ns, next_event_ns, arrivals, drops, delays)


def encode_number(number: int) -> bytes:
    """Return the body of `ping`, `pong` and `busy`: eight bytes."""
    return _TIME.pack(number)


def decode_number(body: bytes) -> int:
    """Return the number in `ping`, `pong` and `busy`.

    Raises:
        MalformedFrameError: The body is malformed.
    """
    reader = FrameReader(body)
    (number,) = reader.unpack(_TIME)
    reader.check_end()
    return int(number)


def encode_fork(copy: int) -> bytes:
    """Return the body of `fork`."""
    return _U32.pack(copy)


def decode_fork(body: bytes) -> int:
    """Return the number of the new copy.

    Raises:
        MalformedFrameError: The body is malformed.
    """
    reader = FrameReader(body)
    (copy,) = reader.unpack(_U32)
    reader.check_end()
    return int(copy)


def decode_text(body: bytes) -> str:
    """Return the text of `error`.

    Raises:
        MalformedFrameError: The body is malformed.
    """
    reader = FrameReader(body)
    text = reader.text()
    reader.check_end()
    return text
