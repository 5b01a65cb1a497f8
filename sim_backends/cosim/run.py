"""What a run says when it is over: what became of every packet, the windows, and what they cost."""

from dataclasses import dataclass, field

from sim_backends.network.packets import Packet
from sim_backends.radio.random_streams import PacketIdentity
from sim_backends.world.motion import State


@dataclass(slots=True)
class Fate:
    """What became of a packet.

    Attributes:
        packet: The packet, with when it was sent and when the network got it.
        known: Where the network took source and destination to be when it got the packet.
        true: Where they were when it was sent: at the physics' last own step, moved on at their velocity of then, so
            that it is right to a h^2 / 2 at an acceleration a and a step h.
        arrived_ns: When it arrived by the network's clock; None if it did not.
        counted_ns: When it arrived by the policy: its window's end, or `arrived_ns`.
        late_ns: By how much its receiver had passed that time already.
        reason: Why it never arrived; empty if it did, or is under way.
        displaced_m: By how much the network was wrong about the distance vector of two of the agents whose places
            count for it, the largest; None if these are source and destination alone (`geometry.displaced_m`).
    """

    packet: Packet
    known: tuple[State, State]
    true: tuple[State, State]
    arrived_ns: int | None = None
    counted_ns: int | None = None
    late_ns: int = 0
    reason: str = ""
    displaced_m: float | None = field(default=None, compare=False)

    @property
    def is_known(self) -> bool:
        """Whether it arrived, or never will."""
        return self.arrived_ns is not None or bool(self.reason)


def no_wall_s() -> dict[str, float]:
    """Return the parts into which wall time is split, each still at 0."""
    return {"agents": 0.0, "network": 0.0, "exchange": 0.0, "wait": 0.0}


@dataclass
class Run:
    """What a run recorded.

    Attributes:
        fates: Of every packet, by flow and number.
        windows_ns: The ends of all windows.
        wall_s: Wall time by part: agents, network, exchange, and wait, in which a federate itself only waited.
        digest: Hash over every packet, arrival, drop and window, in order (`EventDigest`).
    """

    fates: dict[PacketIdentity, Fate] = field(default_factory=dict)
    windows_ns: list[int] = field(default_factory=list)
    wall_s: dict[str, float] = field(default_factory=no_wall_s)
    digest: str = ""
