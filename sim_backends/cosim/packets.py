"""The former place of packets, for branches that name it; they stand in `network.packets`."""

from sim_backends.network.packets import Arrival, Datagram, Drop, Packet, Received

__all__ = ["Arrival", "Datagram", "Drop", "Packet", "Received"]
