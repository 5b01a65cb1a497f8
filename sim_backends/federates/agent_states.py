"""Agents by index, and their states, in the layout of the wire protocol.

Every exchange has the states of all agents, so they are packed and checked together, and a received state is created
when it is requested.
"""

import math
import struct
from collections.abc import Iterable, Iterator, KeysView, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

from typing_extensions import override

from sim_backends.federates.frames import MAX_AGENTS, FrameReader, MalformedFrameError, count_bytes, text_bytes
from sim_backends.world.motion import State

_INDEX: Final = struct.Struct("<I")
_NEW_AGENT_BYTES: Final = _INDEX.size + 2
_STATE_FORMAT: Final = "II8d"
STATE: Final = struct.Struct("<" + _STATE_FORMAT)
_FIELDS: Final = 10
_NO_NEW_AGENTS: Final = count_bytes(0)


@lru_cache(maxsize=32)
def _layout(count: int) -> struct.Struct:
    return struct.Struct("<" + _STATE_FORMAT * count)


class AgentTable:
    """The announced agents, by index.

    Args:
        names: Their names, in order.

    Attributes:
        names: Their names, in order.
        indices: Their indices by name. After an addition it is another mapping, so that received states can keep it.
        order: All indices.
    """

    def __init__(self, names: Iterable[str] = ()) -> None:
        self.names: list[str] = []
        self.indices: dict[str, int] = {}
        self.order: tuple[int, ...] = ()
        self.add(list(names))

    def copy(self) -> "AgentTable":
        """Return an independent copy."""
        return AgentTable(self.names)

    def add(self, names: Sequence[str]) -> None:
        """Add agents with the next indices."""
        self.names = [*self.names, *names]
        self.indices = {name: index for index, name in enumerate(self.names)}
        self.order = tuple(range(len(self.names)))

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
    """Return the announcement of the agents that are not in the table yet, which adds them to it.

    Raises:
        ValueError: There are too many agents.
    """
    if states.keys() <= agents.indices.keys():
        return _NO_NEW_AGENTS
    new = [name for name in states if name not in agents.indices]
    first = len(agents.names)
    if first + len(new) > MAX_AGENTS:
        raise ValueError(f"there are more than {MAX_AGENTS} agents")
    agents.add(new)
    return count_bytes(len(new)) + b"".join(
        _INDEX.pack(index) + text_bytes(name) for index, name in enumerate(new, start=first)
    )


def read_announcements(reader: FrameReader, agents: AgentTable) -> None:
    """Add announced agents to the table.

    Raises:
        MalformedFrameError: An index is not the next one, or a name is known already.
    """
    count = reader.count(_NEW_AGENT_BYTES)
    if not count:
        return
    new: dict[str, None] = {}
    for _ in range(count):
        position, expected = reader.position, len(agents.names) + len(new)
        (index,) = reader.unpack(_INDEX)
        if index != expected or index >= MAX_AGENTS:
            raise MalformedFrameError(position, f"the new agent has index {index}, not {expected}")
        position = reader.position
        name = reader.text()
        if not name or name in agents.indices or name in new:
            raise MalformedFrameError(position, f"the new agent's name {name!r} is empty or known already")
        new[name] = None
    agents.add(list(new))


class ReceivedStates(Mapping[str, State]):
    """States of agents as they were received, each created on request.

    Args:
        rows: Number of each agent's state.
        values: The fields of all states.
        data: Their bytes.
    """

    def __init__(self, rows: Mapping[str, int], values: tuple[Any, ...], data: bytes) -> None:
        self._rows = rows
        self._values = values
        self._cache: dict[str, State] = {}
        self.data = data

    def __deepcopy__(self, memo: dict[int, Any]) -> "ReceivedStates":
        return self  # it is immutable

    def __getitem__(self, name: str) -> State:
        state = self._cache.get(name)
        if state is None:
            begin = self._rows[name] * _FIELDS + 2
            e, n, u, v_e, v_n, v_u, heading_rad = self._values[begin : begin + 7]
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
        """Return True if the indices in its bytes are those of a table, for all of the table's agents."""
        return self._rows == agents.indices

    @property
    def limits_m_s2(self) -> dict[str, float]:
        """The limits of the agents."""
        return dict(zip(self._rows, self._values[9::_FIELDS], strict=True))


def states_bytes(states: Mapping[str, State], agents: AgentTable, limits_m_s2: Mapping[str, float] | None) -> bytes:
    """Return the states of announced agents.

    Args:
        states: The states.
        agents: The agents.
        limits_m_s2: Limits of their accelerations; None if they have no meaning.
    """
    count = len(states)
    if limits_m_s2 is None and isinstance(states, ReceivedStates) and states.has_indices(agents):
        return count_bytes(count) + states.data
    indices = agents.indices
    values: list[float] = []
    for name, (position_m, velocity_m_s, heading_rad) in states.items():
        limit_m_s2 = math.inf if limits_m_s2 is None else limits_m_s2.get(name, math.inf)
        heading = math.nan if heading_rad is None else heading_rad
        values += (indices[name], 0, *position_m, *velocity_m_s, heading, limit_m_s2)
    return count_bytes(count) + _layout(count).pack(*values)


def read_states(reader: FrameReader, agents: AgentTable) -> ReceivedStates:
    """Return states of agents, by name.

    Raises:
        MalformedFrameError: A state is invalid, or an agent has two.
    """
    count = reader.count(STATE.size)
    begin = reader.position
    data = reader.take(count * STATE.size)
    values = _layout(count).unpack(data)
    indices = values[0::_FIELDS]
    if not _seem_valid(values):
        _check_each(values, begin)
    if indices == agents.order:
        return ReceivedStates(agents.indices, values, data)
    rows: dict[str, int] = {}
    for row, index in enumerate(indices):
        name = agents.name(index, begin + row * STATE.size)
        if name in rows:
            raise MalformedFrameError(begin + row * STATE.size, f"agent {name} has two states")
        rows[name] = row
    return ReceivedStates(rows, values, data)


def _seem_valid(values: tuple[Any, ...]) -> bool:
    """Return True if all states are valid; False if one may not be, as sums may be too large for finite numbers."""
    headings, limits = values[8::_FIELDS], values[9::_FIELDS]
    position = sum(values[2::_FIELDS]) + sum(values[3::_FIELDS]) + sum(values[4::_FIELDS])
    velocity = sum(values[5::_FIELDS]) + sum(values[6::_FIELDS]) + sum(values[7::_FIELDS])
    return not (
        any(values[1::_FIELDS])
        or not math.isfinite(position + velocity)
        or math.inf in headings
        or -math.inf in headings
        or not min(limits, default=0.0) >= 0
        or math.isnan(sum(limits))
    )


def _check_each(values: tuple[Any, ...], begin: int) -> None:
    """Check each state.

    Raises:
        MalformedFrameError: One is invalid; the error has its position.
    """
    for row in range(len(values) // _FIELDS):
        index, reserved, *numbers, heading_rad, limit_m_s2 = values[row * _FIELDS : (row + 1) * _FIELDS]
        if reserved or not math.isfinite(sum(numbers)) or math.isinf(heading_rad) or not limit_m_s2 >= 0:
            raise MalformedFrameError(begin + row * STATE.size, f"the state of agent {index} is invalid")
