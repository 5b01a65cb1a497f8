"""Packets that the recorders of Linux's Wi-Fi send from an interface, as root."""

import socket
from pathlib import Path
from typing import Final

_PRIORITY: Final = 0x107
"""Access category VO, which has no block-ACK session: in a session minstrel_ht ignores the reports of hwsim."""
_ETHERTYPE: Final = 0x88B5  # for experiments: IEEE 802


def interface_address(interface: str) -> bytes:
    """Return the MAC address of a network interface."""
    return bytes.fromhex(Path(f"/sys/class/net/{interface}/address").read_text().strip().replace(":", ""))


class PacketSender:
    """Sends Ethernet packets from an interface.

    Args:
        interface: The network interface.
    """

    def __init__(self, interface: str) -> None:
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PRIORITY, _PRIORITY)
        self._socket.bind((interface, 0))
        self._header = interface_address(interface) + _ETHERTYPE.to_bytes(2, "big")

    def send(self, receiver: bytes, payload_bytes: int) -> None:
        """Send a packet to an address, with a payload of zeros."""
        self._socket.send(receiver + self._header + bytes(payload_bytes))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
