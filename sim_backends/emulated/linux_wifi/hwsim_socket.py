"""The socket of the medium of mac80211_hwsim. The module imports little, because supervisors import it."""

from sim_backends.emulated.linux_wifi.hwsim_messages import FAMILY, encode_register
from sim_backends.emulated.linux_wifi.netlink import FamilySocket


def open_registered(fd: int | None = None) -> FamilySocket:
    """Return a socket that is registered as the medium of all radios in the network namespace.

    Args:
        fd: Descriptor of a socket that is already registered; None to open and register one.

    Raises:
        ConfigurationError: The kernel has no hwsim.
    """
    kernel = FamilySocket(FAMILY, fd)
    if fd is None:
        kernel.send(encode_register())
    return kernel
