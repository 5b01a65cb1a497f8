"""Where a robot meets the medium: its TUN device, what crossed it, and where its packets go."""

from collections import defaultdict
from ipaddress import IPv4Interface

from fieldkit.core.model import DelayParts
from sim_backends.emulated.medium.codec import PortCounters
from sim_backends.radio.delay import Delay, parts


class Port:
    """One robot's TUN device, its counters, and where its packets go.

    Args:
        name: The robot.
        address: Its address.
        fd: The device.
    """

    def __init__(self, name: str, address: IPv4Interface, fd: int) -> None:
        self.name = name
        self.address = address
        self.fd = fd
        self.read = 0
        self.refused = 0
        self.unroutable = 0
        self.not_ipv4 = 0
        # So many of the packets that are read next may have waited in the device since then.
        self.old = 0
        self.since_ns = 0
        # Of what was written, by the robot that sent it; what was not written is counted by `refused`.
        self.delays: defaultdict[str, Delay] = defaultdict(int)
        # Destination address -> robot, None for everyone; empty while the robot has no place.
        self.routes: dict[bytes, str | None] = {}

    def delay_parts(self) -> dict[str, DelayParts]:
        """Return what the packets written were delayed by, per robot that sent them."""
        return {source: parts(delay) for source, delay in self.delays.items()}

    @property
    def counters(self) -> PortCounters:
        """What crossed the device so far."""
        written = sum(one.packets for one in self.delay_parts().values())
        return PortCounters(self.read, written, self.refused, self.unroutable, self.not_ipv4)
