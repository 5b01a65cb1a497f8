"""The packets' former place, for branches that name it; they stand in `network.packets`, which needs nothing of here."""

from sim_backends.network.packets import Arrival, Datagram, Drop, Packet, Received

__all__ = ["Arrival", "Datagram", "Drop", "Packet", "Received"]
