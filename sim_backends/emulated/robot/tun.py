"""Opening a TUN device: the end of a robot's radio interface that the medium holds."""

import errno
import fcntl
import os
import socket
import struct
from typing import Final

from fieldkit.core.errors import ConfigurationError, FieldkitError

DEVICE: Final = "/dev/net/tun"
QUEUE_PACKETS: Final = 4096

# linux/if_tun.h
_TUNSETIFF: Final = 0x400454CA
_IFF_TUN: Final = 0x0001
_IFF_NO_PI: Final = 0x1000
# linux/netlink.h, linux/rtnetlink.h and linux/if_link.h
_NLM_F_REQUEST_ACK: Final = 0x1 | 0x4
_RTM_NEWLINK: Final = 16
_IFLA_TXQLEN: Final = 13
_HEADER_BYTES: Final = 16
_ANSWER_BYTES: Final = 4096
_NAME_BYTES: Final = 15


def open_tun(name: str) -> int:
    """Create the TUN interface `name` in this process's network namespace; return its non-blocking descriptor.

    The interface carries bare IP packets and lives as long as the descriptor, in whichever process. It
    queues up to 4096 packets for the medium, so that a pause of the medium is no loss.

    Raises:
        ConfigurationError: The device is missing or closed to this user, or the namespace gives no right.
        FieldkitError: The interface exists already or the kernel refuses its name.
    """
    if not 0 < len(name.encode()) <= _NAME_BYTES:
        raise ConfigurationError(
            f"{name!r} is no name for an interface", remedy=f"use 1 to {_NAME_BYTES} letters, for example wlan0"
        )
    fd = open_device()
    try:
        fcntl.ioctl(fd, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TUN | _IFF_NO_PI))
        _set_queue(socket.if_nametoindex(name))
    except OSError as error:
        os.close(fd)
        raise _cannot_create(name, error) from error
    return fd


def open_device() -> int:
    """Open the TUN device and return its non-blocking descriptor, which has no interface yet.

    Raises:
        ConfigurationError: The device is missing or closed to this user.
    """
    try:
        return os.open(DEVICE, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise _cannot_open(error) from error


def _set_queue(index: int) -> None:
    # By netlink: the ioctl for it, and so busybox's ip, asks for a right that a user namespace never gives.
    link = struct.pack("=BxHiII", socket.AF_UNSPEC, 0, index, 0, 0)
    length = struct.pack("=HHI", 8, _IFLA_TXQLEN, QUEUE_PACKETS)
    size_bytes = _HEADER_BYTES + len(link) + len(length)
    header = struct.pack("=IHHII", size_bytes, _RTM_NEWLINK, _NLM_F_REQUEST_ACK, 0, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as kernel:
        kernel.send(header + link + length)
        (number,) = struct.unpack_from("=i", kernel.recv(_ANSWER_BYTES), _HEADER_BYTES)
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
            "no right to create a TUN interface",
            where=name,
            remedy="run as root, or in a user namespace that owns the network namespace (CAP_NET_ADMIN)",
        )
    remedy = "end the process that holds it, or use another name" if error.errno == errno.EBUSY else ""
    return FieldkitError(f"cannot create the TUN interface: {error.strerror}", where=name, remedy=remedy)
