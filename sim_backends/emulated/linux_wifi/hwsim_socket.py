"""Opens the netlink socket through which a program acts as the radio medium of mac80211_hwsim.

This is a separate module, so that programs that only open the socket for a medium do not import the medium.
"""

from sim_backends.emulated.linux_wifi.hwsim_messages import FAMILY, encode_register
from sim_backends.emulated.linux_wifi.netlink import FamilySocket


def open_registered(fd: int | None = None) -> FamilySocket:
    """Return a socket that is registered as the medium of all radios that were created in this network namespace.

    It remains their medium if they are moved to other namespaces.

    Args:
        fd: Descriptor of a socket that is already registered; None to open and register one.

    Raises:
        ConfigurationError: The kernel has no mac80211_hwsim.
    """
    kernel = FamilySocket(FAMILY, fd)
    if fd is None:
        kernel.send(encode_register())
    return kernel
