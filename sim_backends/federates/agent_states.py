"""Announced agents and their states, in the layout of the wire protocol of federates.

A message announces each agent once, with its name and its index; later messages contain only the index. A state
consists of the index of the agent, a reserved field, its position, velocity and heading, and the limit of its
acceleration. Every exchange contains the states of all agents, so they are packed and checked together. A received
state is unpacked only when it is requested.
"""

import math
import struct
from collections.abc import Iterable, Iterator, KeysView, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final, NamedTuple

from typing_extensions import override

from sim_backends.federates.frames import MAX_AGENTS, FrameReader, MalformedFrameError, count_bytes, text_bytes
from sim_backends.world.motion import State

_INDEX: Final = struct.Struct("<I")
_NEW_AGENT_BYTES: Final = _INDEX.size + 2
"""Smallest size of an announcement: the index, and the length of the name."""
STATE: Final = struct.Struct("<II8d")
_MOTION: Final = struct.Struct("<7d")
_MOTION_OFFSET: Final = 8
"""Offset of position, velocity and heading in a state: they follow the index and the reserved field."""
_NO_NEW_AGENTS: Final = count_bytes(0)


class _Layouts(NamedTuple):
    """Layouts of `struct` that each read one part of many states and skip the others.

    Attributes:
        indices: The index and the reserved field as one number, which equals the index if the reserved field is 0.
        positions: Positions and velocities.
        headings: The headings.
        acceleration_limits: The acceleration limits.
    """

    indices: struct.Struct
    positions: struct.Struct
    headings: struct.Struct
    acceleration_limits: struct.Struct


@lru_cache(maxsize=32)
def _layouts(count: int) -> _Layouts:
    formats = ("Q64x", "8x6d16x", "56xd8x", "64xd")
    return _Layouts(*(struct.Struct("<" + text * count) for text in formats))


class AgentTable:
    """The announced agents, by index.

    Args:
        names: Their names, in order.

    Attributes:
        names: Their names, in order.
        indices: Their indices by name. An addition replaces the mapping, so that received states can keep the
            previous one.
        all_indices: All indices.
        valid_limits: The acceleration limits in the last received states. They seldom change, and equal limits are
            not checked again.
    """

    def __init__(self, names: Iterable[str] = ()) -> None:
        self.names: list[str] = []
        self.indices: dict[str, int] = {}
        self.all_indices: tuple[int, ...] = ()
        self.valid_limits: tuple[float, ...] = ()
        self.add(list(names))

    def copy(self) -> "AgentTable":
        """Return an independent copy."""
        return AgentTable(self.names)

    def add(self, names: Sequence[str]) -> None:
        """Add agents with the next indices."""
        self.names = [*self.names, *names]
        self.indices = {name: index for index, name in enumerate(self.names)}
        self.all_indices = tuple(range(len(self.names)))

    def name(self, index: int, position: int) -> str:
        """Return the name of an agent.

        Args:
            index: Its index.
            position: Position of the index in the frame, for the error.

        Raises:
            MalformedFrameError: There is no such agent.
        """
        if index >= len(self.names):
            raise MalformedFrameError(position, f"agent {index} was not announced")
        return self.names[index]


def announcements_bytes(states: Mapping[str, State], agents: AgentTable) -> bytes:
    """Return the announcement of the agents that are not in the table yet, and add them to the table.

    Raises:
        ValueError: There are too many agents, or a name is too long.
    """
    if states.keys() <= agents.indices.keys():
        return _NO_NEW_AGENTS
    new_names = [name for name in states if name not in agents.indices]
    first = len(agents.names)
    if first + len(new_names) > MAX_AGENTS:
        raise ValueError(f"there are more than {MAX_AGENTS} agents")
    agents.add(new_names)
    return count_bytes(len(new_names)) + b"".join(
        _INDEX.pack(index) + text_bytes(name) for index, name in enumerate(new_names, start=first)
    )


def read_announcements(reader: FrameReader, agents: AgentTable) -> None:
    """Add announced agents to the table.

    Raises:
        MalformedFrameError: An index is not the next free index, there are too many agents, or a name is empty or
            already in use.
    """
    count = reader.count(_NEW_AGENT_BYTES)
    if not count:
        return
    new_names: dict[str, None] = {}
    for _ in range(count):
        position, expected = reader.position, len(agents.names) + len(new_names)
        (index,) = reader.unpack(_INDEX)
        if index != expected:
            raise MalformedFrameError(position, f"the new agent has index {index}, not {expected}")
        if index >= MAX_AGENTS:
            raise MalformedFrameError(position, f"there are more than {MAX_AGENTS} agents")
        position = reader.position
        name = reader.text()
        if not name or name in agents.indices or name in new_names:
            raise MalformedFrameError(position, f"the new agent's name {name!r} is empty or already in use")
        new_names[name] = None
    agents.add(list(new_names))


class ReceivedStates(Mapping[str, State]):
    """Received states of agents; each is unpacked on request.

    Args:
        rows: Row of each agent's state in `data`.
        data: The bytes of the states.
        limits: Acceleration limits of the agents, in m/s^2, in the order of the rows.
    """

    def __init__(self, rows: Mapping[str, int], data: bytes, limits: tuple[float, ...]) -> None:
        self._rows = rows
        self._limits = limits
        self._cache: dict[str, State] = {}
        self.data = data

    def __deepcopy__(self, memo: dict[int, Any]) -> "ReceivedStates":
        return self  # it is immutable

    def __getitem__(self, name: str) -> State:
        state = self._cache.get(name)
        if state is None:
            offset = self._rows[name] * STATE.size + _MOTION_OFFSET
            e, n, u, v_e, v_n, v_u, heading_rad = _MOTION.unpack_from(self.data, offset)
            # NaN, which means no heading, is the only number that is not equal to itself.
            heading = heading_rad if heading_rad == heading_rad else None  # noqa: PLR0124 (see above)
            state = self._cache[name] = State((e, n, u), (v_e, v_n, v_u), heading)
        return state

    @override
    def keys(self) -> KeysView[str]:
        return self._rows.keys()

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def has_indices(self, agents: AgentTable) -> bool:
        """Return True if the states have the same agents with the same indices as the table."""
        return self._rows is agents.indices or self._rows == agents.indices

    def has_limits_of(self, other: Mapping[str, State]) -> bool:
        """Return True if other states have the same agents and acceleration limits.

        The mappings of agents are compared by identity, so the result may be False although the agents are equal.
        """
        return isinstance(other, ReceivedStates) and self._rows is other._rows and self._limits == other._limits  # noqa: SLF001 (of the same class)

    @property
    def limits_m_s2(self) -> dict[str, float]:
        """The acceleration limits of the agents."""
        return dict(zip(self._rows, self._limits, strict=True))


def states_bytes(states: Mapping[str, State], agents: AgentTable, limits_m_s2: Mapping[str, float] | None) -> bytes:
    """Return the states of announced agents as bytes.

    Args:
        states: The states.
        agents: The agents.
        limits_m_s2: Acceleration limits of the agents; None if the receiver ignores them.
    """
    count = len(states)
    if limits_m_s2 is None and isinstance(states, ReceivedStates) and states.has_indices(agents):
        return count_bytes(count) + states.data
    limits = {} if limits_m_s2 is None else limits_m_s2
    indices, pack, nan, infinity = agents.indices, STATE.pack, math.nan, math.inf
    parts = [
        pack(
            indices[name], 0, e, n, u, v_e, v_n, v_u, nan if heading is None else heading, limits.get(name, infinity)
        )
        for name, ((e, n, u), (v_e, v_n, v_u), heading) in states.items()
    ]
    return count_bytes(count) + b"".join(parts)


def read_states(reader: FrameReader, agents: AgentTable) -> ReceivedStates:
    """Return the next list of states in a frame, by name of the agent.

    Raises:
        MalformedFrameError: A state is invalid, an agent has two states, or an agent was not announced.
    """
    count = reader.count(STATE.size)
    begin = reader.position
    return unpack_states(reader.read_bytes(count * STATE.size), begin, agents)


def unpack_states(data: bytes, begin: int, agents: AgentTable) -> ReceivedStates:
    """Return states of agents, by name.

    Args:
        data: The bytes of the states.
        begin: Position of the first state in the frame.
        agents: The agents.

    Raises:
        MalformedFrameError: A state is invalid, an agent has two states, or an agent was not announced.
    """
    layouts = _layouts(len(data) // STATE.size)
    indices, limits = layouts.indices.unpack(data), layouts.acceleration_limits.unpack(data)
    headings = layouts.headings.unpack(data)
    # The sum of finite numbers may overflow; then each number is checked.
    if not (
        math.isfinite(sum(layouts.positions.unpack(data)))
        and math.inf not in headings
        and -math.inf not in headings
        and (limits == agents.valid_limits or (min(limits, default=0.0) >= 0 and not math.isnan(sum(limits))))
    ):
        _check_each(data, begin)
    agents.valid_limits = limits
    if indices == agents.all_indices:
        return ReceivedStates(agents.indices, data, limits)
    # The indices have another order, or a reserved field is not 0, which is an error.
    _check_each(data, begin)
    rows: dict[str, int] = {}
    for row, index in enumerate(indices):
        name = agents.name(index, begin + row * STATE.size)
        if name in rows:
            raise MalformedFrameError(begin + row * STATE.size, f"agent {name} has two states")
        rows[name] = row
    return ReceivedStates(rows, data, limits)


def _check_each(data: bytes, begin: int) -> None:
    """Check each state.

    Raises:
        MalformedFrameError: A state is invalid; the error has the position of this state.
    """
    for row, (index, reserved, *numbers, heading_rad, limit_m_s2) in enumerate(STATE.iter_unpack(data)):
        if reserved or not math.isfinite(sum(numbers)) or math.isinf(heading_rad) or not limit_m_s2 >= 0:
            raise MalformedFrameError(begin + row * STATE.size, f"the state of agent {index} is invalid")
