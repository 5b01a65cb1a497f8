"""What goes wrong with radios: nodes that are lost, links that are cut, jammers; each from one moment to another."""

from collections.abc import Sequence
from dataclasses import dataclass

from fieldkit.core.model import Vector


@dataclass(frozen=True, slots=True)
class NodeLoss:
    """A node is off: what waits in its radio's queue is lost, and what its programs send meanwhile.

    Its transports stand still: their timers ring when it is on again, if it ever is, and not before.

    Attributes:
        name: The node.
        begin_ns: From when on.
        end_ns: Until when; None to the end of the run.
    """

    name: str
    begin_ns: int
    end_ns: int | None = None


@dataclass(frozen=True, slots=True)
class LinkCut:
    """Two nodes are out of each other's range, in both directions.

    Attributes:
        one: One of them.
        other: The other.
        begin_ns: From when on.
        end_ns: Until when; None to the end of the run.
    """

    one: str
    other: str
    begin_ns: int
    end_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Jammer:
    """Noise in the whole channel, sent without a pause from a place, or by an agent wherever it is.

    Attributes:
        power_dbm: Power that it sends with, within the channel's 20 MHz.
        begin_ns: From when on.
        end_ns: Until when; None to the end of the run.
        place_m: Where it stands, metres east, north, up; None where an agent carries it.
        agent: Who carries it; empty for nobody.

    Raises:
        ValueError: It has neither a place nor an agent, or both.
    """

    power_dbm: float
    begin_ns: int
    end_ns: int | None = None
    place_m: Vector | None = None
    agent: str = ""

    def __post_init__(self) -> None:
        if (self.place_m is None) == (not self.agent):
            raise ValueError("a jammer needs either a place or an agent that carries it")


Disturbance = NodeLoss | LinkCut | Jammer


def active(disturbances: Sequence[Disturbance], now_ns: int) -> list[Disturbance]:
    """Return those that have begun and not ended at `now_ns`."""
    return [one for one in disturbances if one.begin_ns <= now_ns and (one.end_ns is None or now_ns < one.end_ns)]


def changes_ns(disturbances: Sequence[Disturbance]) -> list[int]:
    """Return when any begins or ends, each time once, in order."""
    edges = {one.begin_ns for one in disturbances}
    return sorted(edges | {one.end_ns for one in disturbances if one.end_ns is not None})
