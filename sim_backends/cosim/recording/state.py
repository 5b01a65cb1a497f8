"""The state of a recording between two parts, and the rows that windows add to its tables."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Self

from sim_backends.cosim.digest import EventDigest
from sim_backends.cosim.observer import Window
from sim_backends.cosim.recording import tables
from sim_backends.cosim.run import Fate
from sim_backends.world.motion import State

Row = tables.Row
Rows = dict[str, list[Row]]


@dataclass
class RecordingState:
    """The state of a recording between two parts.

    Attributes:
        parts: Number of parts of each table.
        windows: Number of recorded windows.
        digest: Hash over all their events.
        under_way: Packets whose fate is not decided yet, by packet id, each with the window in which it entered.
        checksums: Checksums of all files of tables, by path.
    """

    parts: int = 0
    windows: int = 0
    digest: EventDigest = field(default_factory=EventDigest)
    under_way: dict[int, tuple[Fate, int]] = field(default_factory=dict)
    checksums: dict[str, str] = field(default_factory=dict)

    def copy(self) -> Self:
        """Return an independent copy."""
        return replace(
            self, digest=deepcopy(self.digest), under_way=dict(self.under_way), checksums=dict(self.checksums)
        )

    def add_windows(self, windows: Sequence[Window]) -> Rows:
        """Add windows to the state, and return the rows of each table."""
        rows: Rows = {table: [] for table in tables.TABLES}
        for window in windows:
            for fate in window.entered:
                self.under_way[fate.packet.packet_id] = fate, self.windows
            for fate in window.ended:
                _, entered_window = self.under_way.pop(fate.packet.packet_id)
                rows["packets"].append(_packet_row(fate, entered_window, self.windows))
            rows["windows"].append(
                (
                    self.windows,
                    window.begin_ns,
                    window.end_ns,
                    window.decided_by,
                    *(window.wall_s[part] for part in ("agents", "network", "exchange", "wait")),
                )
            )
            rows["states"] += state_rows(window.end_ns, window.states)
            self.digest.add_window(window.end_ns, window.entered, window.ended)
            self.windows += 1
        return rows

    def undecided_rows(self) -> list[Row]:
        """Return the rows of `packets` for the packets that are under way."""
        return [_packet_row(fate, entered_window, None) for fate, entered_window in self.under_way.values()]


def state_rows(at_ns: int, states: Mapping[str, State]) -> list[Row]:
    """Return the rows of `states` at a time."""
    return [(at_ns, name, *_values(state)) for name, state in states.items()]


def _packet_row(fate: Fate, entered_window: int, ended_window: int | None) -> Row:
    packet = fate.packet
    # The fate may have been decided in a window that was interrupted and is not recorded.
    outcome = (
        (None, None, 0, "") if ended_window is None else (fate.arrived_ns, fate.counted_ns, fate.late_ns, fate.reason)
    )
    ends = (*fate.assumed, *fate.true)
    return (
        packet.packet_id,
        *packet.identity,
        packet.source,
        packet.destination,
        packet.protocol,
        packet.size_bytes,
        packet.sent_ns,
        packet.enters_ns,
        entered_window,
        *outcome,
        ended_window,
        *(value for state in ends for value in _values(state)),
    )


def _values(state: State) -> Row:
    return state.position_m, state.velocity_m_s, state.heading_rad
