"""TUN and TAP interfaces: the radio interfaces of emulated robots."""

import errno
import fcntl
import os
import socket
import struct
from typing import Final

from fieldkit.core.errors import ConfigurationError, FieldkitError

DEVICE: Final = "/dev/net/tun"
QUEUE_PACKETS: Final = 4096
"""Length of the transmit queue of an interface."""

# linux/if_tun.h
_TUNSETIFF: Final = 0x400454CA
_IFF_TUN: Final = 0x0001
_IFF_TAP: Final = 0x0002
_IFF_NO_PI: Final = 0x1000
# linux/netlink.h, linux/rtnetlink.h and linux/if_link.h
_NLM_F_REQUEST_ACK: Final = 0x1 | 0x4
_RTM_NEWLINK: Final = 16
_IFLA_TXQLEN: Final = 13
_HEADER_BYTES: Final = 16
_REPLY_BYTES: Final = 4096
_NAME_BYTES: Final = 15


def open_tun(name: str, *, ethernet: bool = False) -> int:
    """Create the TUN interface `name` in this process's network namespace; return its non-blocking descriptor.

    The interface carries bare IP packets, or Ethernet frames (TAP), and exists as long as a process has the
    descriptor open. Its queue holds 4096 packets, so that no packet is lost in a short pause of the medium process.

    Raises:
        ConfigurationError: The name is empty or too long, the device is missing, or this user may not open it or
            create an interface.
        FieldkitError: The interface exists already or the kernel refuses its name.
    """
    if not 0 < len(name.encode()) <= _NAME_BYTES:
        raise ConfigurationError(
            f"{name!r} is not a valid interface name",
            remedy=f"use 1 to {_NAME_BYTES} ASCII characters, for example wlan0",
        )
    fd = open_device()
    try:
        kind = _IFF_TAP if ethernet else _IFF_TUN
        fcntl.ioctl(fd, _TUNSETIFF, struct.pack("16sH22x", name.encode(), kind | _IFF_NO_PI))
        _set_queue(socket.if_nametoindex(name))
    except OSError as error:
        os.close(fd)
        raise _cannot_create(name, error) from error
    return fd


def open_device() -> int:
    """Open the TUN device and return its non-blocking descriptor, which has no interface yet.

    Raises:
        ConfigurationError: The device is missing, or this user may not open it.
    """
    try:
        return os.open(DEVICE, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise _cannot_open(error) from error


def _set_queue(index: int) -> None:
    """Set the queue length of the interface with this index to `QUEUE_PACKETS`."""
    # Netlink is used, because the ioctl (also in busybox's ip) needs a capability that no user namespace grants. The
    # message consists of the structs nlmsghdr, ifinfomsg and rtattr.
    link = struct.pack("=BxHiII", socket.AF_UNSPEC, 0, index, 0, 0)
    length = struct.pack("=HHI", 8, _IFLA_TXQLEN, QUEUE_PACKETS)
    size_bytes = _HEADER_BYTES + len(link) + len(length)
    header = struct.pack("=IHHII", size_bytes, _RTM_NEWLINK, _NLM_F_REQUEST_ACK, 0, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as kernel:
        kernel.send(header + link + length)
        (number,) = struct.unpack_from("=i", kernel.recv(_REPLY_BYTES), _HEADER_BYTES)
    if number != 0:
        raise OSError(-number, os.strerror(-number))


def _cannot_open(error: OSError) -> ConfigurationError:
    if error.errno in {errno.ENOENT, errno.ENODEV, errno.ENXIO}:
        remedy = "load the module: modprobe tun; in a container, start it with --device /dev/net/tun"
    else:
        remedy = f"allow this user to open it: sudo chmod 666 {DEVICE}"
    return ConfigurationError(f"cannot open the TUN device: {error.strerror}", where=DEVICE, remedy=remedy)


def _cannot_create(name: str, error: OSError) -> FieldkitError:
    if error.errno == errno.EPERM:
        return ConfigurationError(
            "no permission to create a TUN interface",
            where=name,
            remedy="run as root, or in a user namespace that owns the network namespace (CAP_NET_ADMIN)",
        )
    remedy = "stop the process that has it open, or use another name" if error.errno == errno.EBUSY else ""
    return FieldkitError(f"cannot create the TUN interface: {error.strerror}", where=name, remedy=remedy)
