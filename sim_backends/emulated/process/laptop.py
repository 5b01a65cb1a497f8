"""The operator's laptop: a node of the lab where SSH crosses the radio under test."""

import socket
from typing import Final

from fieldkit.config.profiles import Radio
from sim_backends.emulated.process.node import Node
from sim_backends.emulated.robot.ssh_server import SSH_PORT

NAME: Final = "laptop"

# Like the robots' own radios, so that a link is as good in both directions.
RADIO: Final = Radio(interface="wlan0", standard="802.11n 2.4 GHz", tx_power_dbm=17, sensitivity_dbm=-82)


class Laptop(Node):
    """A node that reaches robots over the medium.

    Args:
        address: Its address with the length of the network.

    Raises:
        ConfigurationError: As `Node`.
    """

    def __init__(self, address: str) -> None:
        super().__init__(NAME, interface=RADIO.interface, address=address)

    def reach(self, address: str, timeout_s: float) -> socket.socket:
        """Return a stream to the SSH server of the robot at `address`. Errors as `stream_to`."""
        return self.stream_to(address, SSH_PORT, timeout_s)
