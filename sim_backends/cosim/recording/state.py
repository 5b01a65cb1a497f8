"""What a recording has so far, and the rows that the next windows add to it."""

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
        parts: How many there are of each table.
        windows: How many windows are recorded.
        digest: Of all their events.
        under_way: Packets whose fate no window told yet, by packet id, each with the window in which it entered.
        checksums: Of all files of tables, by path.
    """

    parts: int = 0
    windows: int = 0
    digest: EventDigest = field(default_factory=EventDigest)
    under_way: dict[int, tuple[Fate, int]] = field(default_factory=dict)
    checksums: dict[str, str] = field(default_factory=dict)

    def copy(self) -> Self:
        """Return one that goes on from here by itself."""
        return replace(
            self, digest=deepcopy(self.digest), under_way=dict(self.under_way), checksums=dict(self.checksums)
        )

    def take(self, windows: Sequence[Window]) -> Rows:
        """Take windows into the state; return the rows of each table."""
        rows: Rows = {table: [] for table in tables.TABLES}
        for window in windows:
            for fate in window.entered:
                self.under_way[fate.packet.packet_id] = fate, self.windows
            for fate in window.ended:
                _, entered = self.under_way.pop(fate.packet.packet_id)
                rows["packets"].append(_packet(fate, entered, self.windows))
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
            self.digest.window(window.end_ns, window.entered, window.ended)
            self.windows += 1
        return rows

    def end(self) -> list[Row]:
        """Return rows of `packets` for those that are under way at the end."""
        return [_packet(fate, entered, None) for fate, entered in self.under_way.values()]


def state_rows(at_ns: int, of: Mapping[str, State]) -> list[Row]:
    """Return rows of `states`."""
    return [(at_ns, name, *_values(state)) for name, state in of.items()]


def _packet(fate: Fate, entered: int, ended: int | None) -> Row:
    packet = fate.packet
    # A window that was broken off may have told a fate that is not recorded.
    told = (None, None, 0, "") if ended is None else (fate.arrived_ns, fate.counted_ns, fate.late_ns, fate.reason)
    ends = (*fate.known, *fate.true)
    return (
        packet.packet_id,
        *packet.identity,
        packet.source,
        packet.destination,
        packet.protocol,
        packet.size_bytes,
        packet.sent_ns,
        packet.enters_ns,
        entered,
        *told,
        ended,
        *(value for state in ends for value in _values(state)),
    )


def _values(state: State) -> Row:
    return state.position_m, state.velocity_m_s, state.heading_rad
