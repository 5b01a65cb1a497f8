"""Command lines of a transfer for each netcat, so that the whole file arrives and both ends exit.

Tested manually with each pair of sender and receiver and a receiver that reads slowly (traditional 1.10-47, OpenBSD
1.219, ncat 7.93, busybox 1.35.0). The rules are:

- A listener must not close its sending direction at the end of its standard input: a traditional or busybox sender
  would treat this as the end of the connection and exit with code 0 before the file is complete. ncat and busybox
  close it, so they get an input that never ends.
- A sender must exit at the end of its input: `-q 0` or `--send-only`. OpenBSD's `-N` has the same effect, but its
  version in Ubuntu 16.04 does not support it.
- A UDP listener exits after an idle time: `-w`, or `-i` for ncat, which then exits with code 2. In the traditional
  netcat, the time before the first datagram counts too; the others wait until the limit of the job.
"""

import re
from collections.abc import Iterator, Mapping
from typing import Final

from fieldkit.core.model import Protocol, Role
from fieldkit.steps.scene import Refusal
from fieldkit.steps.variants import Netcat

DATAGRAM_BYTES: Final[Mapping[Netcat, int]] = {Netcat.TRADITIONAL: 8192, Netcat.OPENBSD: 16384, Netcat.NCAT: 8192}
"""Payload of each datagram except the last one of the file; busybox as built by Debian has no UDP."""

_READ_BYTES: Final = {Netcat.TRADITIONAL: 8192, Netcat.OPENBSD: 16384, Netcat.NCAT: 8192}
_OLD_NCAT_READ_BYTES: Final = 131072
"""Maximum number of bytes that a listener reads from a datagram, and the number for ncat before `_NCAT_CHANGED`."""
_NCAT_CHANGED: Final = (7, 94)
"""Since this version (Debian 13 has 7.95) a listening ncat reads UDP into its TCP buffer of 8192 bytes (commit
4e6c8feb1 of nmap), so that longer datagrams are truncated."""
_NCAT_VERSION: Final = re.compile(r"Ncat\D*(\d+)\.(\d\d)")

# A FIFO that is open for reading and writing neither blocks on open nor reports an end of file.
_ENDLESS_INPUT: Final = ("sh", "-c", 'mkfifo .endless && exec <>.endless && rm .endless && exec "$@"', "sh")


def listen(netcat: Netcat, program: str, protocol: Protocol, port: int, idle_s: int) -> tuple[str, ...]:
    """Return the command that writes the data received on `port` to its standard output."""
    is_udp = protocol is Protocol.UDP
    match netcat:
        case Netcat.OPENBSD:
            return (program, *(("-u", "-w", str(idle_s)) if is_udp else ()), "-l", str(port))
        case Netcat.NCAT if is_udp:
            return (program, "-u", "--recv-only", "-i", str(idle_s), "-l", str(port))
        case Netcat.NCAT:
            return (*_ENDLESS_INPUT, program, "--recv-only", "-l", str(port))
        case Netcat.BUSYBOX:
            return (*_ENDLESS_INPUT, program, *(("-u",) if is_udp else ()), "-l", "-p", str(port))
        case Netcat.TRADITIONAL:
            idle_options = ("-w", str(idle_s)) if is_udp else ()
            return (program, *(("-u",) if is_udp else ()), "-l", "-p", str(port), *idle_options)


def send(netcat: Netcat, program: str, protocol: Protocol, address: str, port: int) -> tuple[str, ...]:
    """Return the command that sends its standard input to `address` and `port`."""
    exit_options = {Netcat.NCAT: ("--send-only",), Netcat.BUSYBOX: ()}.get(netcat, ("-q", "0"))
    return (program, *(("-u",) if protocol is Protocol.UDP else ()), *exit_options, address, str(port))


def sender_was_killed(code: int | None, log: str | None) -> bool:
    """Return True if the exit code and the log show that a traditional netcat was terminated by a signal.

    It catches signals, writes an empty line and exits with code 1; after other errors it writes a message (1.10-47,
    tested manually). For other netcats the exit code alone shows the signal.
    """
    return code == 1 and log == "\n"


def listener_failed(code: int | None, log: str | None) -> bool:
    """Return True if a listener was terminated by a signal (see `sender_was_killed`) or could not write.

    On a full disk (tested manually), the traditional netcat exits with code 1 without a message, busybox and ncat
    write a message, and the OpenBSD netcat exits as after a complete transfer. After an idle time (`-w`, `-i`) a
    listener writes a message and exits with code 1, or 2 for ncat.
    """
    return code in {1, 2} and log is not None and (not log.strip() or "write" in log)


def truncates_datagrams(sender: Netcat, receiver: Netcat, receiver_version: str = "") -> bool:
    """Return True if the receiver reads fewer bytes of a datagram than the sender writes, and drops the rest.

    Args:
        sender: The netcat of the sender.
        receiver: The netcat of the receiver.
        receiver_version: Version text of the receiver's netcat; empty if unknown.
    """
    both_have_udp = sender in DATAGRAM_BYTES and receiver in _READ_BYTES
    return both_have_udp and DATAGRAM_BYTES[sender] > _read_bytes(receiver, receiver_version)


def udp_refusals(
    netcats: Mapping[Role, Netcat], sender: Role, receiver: Role, receiver_version: str
) -> Iterator[Refusal]:
    """Yield the reasons why the netcats of two robots cannot transfer a file over UDP.

    Args:
        netcats: The netcat of both roles.
        sender: Role of the sender.
        receiver: Role of the receiver.
        receiver_version: Version text of the receiver's netcat; empty if unknown.
    """
    for role, netcat in netcats.items():
        if netcat is Netcat.BUSYBOX:
            remedy = "sudo apt-get install netcat-traditional, and write netcat: nc.traditional in its profile"
            yield Refusal(role, "busybox nc has no UDP", remedy)
    if truncates_datagrams(netcats[sender], netcats[receiver], receiver_version):
        size = DATAGRAM_BYTES[netcats[sender]]
        reason = f"its netcat truncates the datagrams of {size} bytes from the sender's netcat"
        remedy = "sudo apt-get install netcat-openbsd, and write netcat: nc.openbsd in its profile"
        yield Refusal(receiver, reason, remedy)


def _read_bytes(netcat: Netcat, version: str) -> int:
    """Return the maximum number of bytes that a listener reads from a datagram."""
    numbers = _NCAT_VERSION.search(version)
    if netcat is Netcat.NCAT and numbers and (int(numbers[1]), int(numbers[2])) < _NCAT_CHANGED:
        return _OLD_NCAT_READ_BYTES
    return _READ_BYTES[netcat]
