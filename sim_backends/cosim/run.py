"""The record of a run: the fate of every packet, the windows, and the wall time."""

from dataclasses import dataclass, field

from sim_backends.network.packets import Packet
from sim_backends.radio.random_streams import PacketIdentity
from sim_backends.world.motion import State


@dataclass(slots=True)
class Fate:
    """The fate of a packet: arrived, dropped, or not decided yet.

    Attributes:
        packet: The packet, with the times when it was sent and when it entered the network.
        assumed: States of source and destination that the network assumed when the packet entered.
        true: True states of source and destination at the time of sending: those at the last physics step,
            extrapolated at their velocity. At an acceleration a and a step h the error is at most a h^2 / 2.
        arrived_ns: Time when the network delivered it, or None.
        counted_ns: Time when its receiver got it, which depends on the policy: the window's end, or `arrived_ns`.
        late_ns: How far the receiver had passed `counted_ns` already.
        reason: Why it never arrived; empty if it arrived or is under way.
        position_error_m: Largest error of the relative position that the network assumed for two of the agents that
            matter for the packet; None if these are source and destination only (`geometry.position_error_m`).
    """

    packet: Packet
    assumed: tuple[State, State]
    true: tuple[State, State]
    arrived_ns: int | None = None
    counted_ns: int | None = None
    late_ns: int = 0
    reason: str = ""
    position_error_m: float | None = field(default=None, compare=False)

    @property
    def is_decided(self) -> bool:
        """True if it arrived, or never will."""
        return self.arrived_ns is not None or bool(self.reason)


def no_wall_s() -> dict[str, float]:
    """Return the parts of the wall time, each 0."""
    return {"agents": 0.0, "network": 0.0, "exchange": 0.0, "wait": 0.0}


@dataclass
class Run:
    """The record of a run.

    Attributes:
        fates: The fate of every packet, by flow and number.
        windows_ns: The ends of all windows.
        wall_s: Wall time by part: agents, network, exchange, and wait, which is the time that federates only waited.
        digest: Hash over every packet, arrival, drop and window, in order (`EventDigest`).
    """

    fates: dict[PacketIdentity, Fate] = field(default_factory=dict)
    windows_ns: list[int] = field(default_factory=list)
    wall_s: dict[str, float] = field(default_factory=no_wall_s)
    digest: str = ""
