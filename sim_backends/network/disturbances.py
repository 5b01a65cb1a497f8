"""Radio disturbances: nodes that are off, links that are cut, jammers; each with a start and an end time."""

from collections.abc import Sequence
from dataclasses import dataclass

from fieldkit.core.model import Vector


@dataclass(frozen=True, slots=True)
class NodeLoss:
    """A node is off: packets in its radio's queue and packets that its programs send in this time are lost.

    Its transports are suspended: timers that expire in this time fire when the node is on again.

    Attributes:
        name: The node.
        begin_ns: Start time.
        end_ns: End time; None for the end of the run.
    """

    name: str
    begin_ns: int
    end_ns: int | None = None


@dataclass(frozen=True, slots=True)
class LinkCut:
    """Two nodes are out of range of each other, in both directions.

    Attributes:
        first: One of the nodes.
        second: The other node.
        begin_ns: Start time.
        end_ns: End time; None for the end of the run.
    """

    first: str
    second: str
    begin_ns: int
    end_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Jammer:
    """Continuous noise in the whole channel, from a fixed position or from the position of an agent.

    Attributes:
        power_dbm: Transmit power within the channel's 20 MHz.
        begin_ns: Start time.
        end_ns: End time; None for the end of the run.
        position_m: Its position, metres east, north, up; None if an agent carries it.
        agent: The agent that carries it; empty if it has a fixed position.

    Raises:
        ValueError: The jammer has neither a position nor an agent, or both.
    """

    power_dbm: float
    begin_ns: int
    end_ns: int | None = None
    position_m: Vector | None = None
    agent: str = ""

    def __post_init__(self) -> None:
        if (self.position_m is None) == (not self.agent):
            raise ValueError("a jammer needs either a position or an agent that carries it")


Disturbance = NodeLoss | LinkCut | Jammer


def active(disturbances: Sequence[Disturbance], now_ns: int) -> list[Disturbance]:
    """Return the disturbances that are active at `now_ns`."""
    return [
        disturbance
        for disturbance in disturbances
        if disturbance.begin_ns <= now_ns and (disturbance.end_ns is None or now_ns < disturbance.end_ns)
    ]


def changes_ns(disturbances: Sequence[Disturbance]) -> list[int]:
    """Return the distinct start and end times of all disturbances, in order."""
    starts = {disturbance.begin_ns for disturbance in disturbances}
    return sorted(starts | {disturbance.end_ns for disturbance in disturbances if disturbance.end_ns is not None})
