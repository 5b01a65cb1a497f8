"""Command lines of a transfer for each netcat: the whole file arrives, and both ends end by themselves.

Tried by hand, sender by receiver, with a receiver that reads slowly (traditional 1.10-47, OpenBSD 1.219, ncat 7.93,
busybox 1.35.0). Three things decide:

- A listener must not close its sending half when its standard input ends: a traditional or busybox sender takes that
  for the end of the connection and leaves with exit code 0, the file cut short. ncat and busybox close it, so they
  get an input that never ends.
- A sender must leave when its input has ended: `-q 0`, or `--send-only`. OpenBSD's `-N` would do as well, but the one
  of Ubuntu 16.04 does not know it.
- A UDP listener ends by an idle time: `-w`, and `-i` for ncat, which then exits with 2. Before the first datagram the
  traditional one counts too, the others wait for the job's limit.
"""

import re
from collections.abc import Mapping
from typing import Final

from fieldkit.core.model import Protocol
from fieldkit.steps.variants import Netcat

DATAGRAM_BYTES: Final[Mapping[Netcat, int]] = {Netcat.TRADITIONAL: 8192, Netcat.OPENBSD: 16384, Netcat.NCAT: 8192}
"""Payload of the datagrams that each sends, the file's last one apart; busybox (as Debian builds it) has no UDP."""

_READ_BYTES: Final = {Netcat.TRADITIONAL: 8192, Netcat.OPENBSD: 16384, Netcat.NCAT: 8192}
_OLD_NCAT_READ_BYTES: Final = 131072
_NCAT_CHANGED: Final = (7, 94)
"""From this version on (Debian 13 has 7.95) a listening ncat reads UDP into its buffer for TCP, of 8192 bytes (nmap's
commit 4e6c8feb1). The rest of a longer datagram is lost.
"""
_NCAT_VERSION: Final = re.compile(r"Ncat\D*(\d+)\.(\d\d)")

# Opened for reading and writing, a FIFO neither blocks nor ends.
_ENDLESS_INPUT: Final = ("sh", "-c", 'mkfifo .endless && exec <>.endless && rm .endless && exec "$@"', "sh")


def listen(netcat: Netcat, program: str, protocol: Protocol, port: int, idle_s: int) -> tuple[str, ...]:
    """Return the command that writes what arrives at `port` to its standard output."""
    udp = protocol is Protocol.UDP
    match netcat:
        case Netcat.OPENBSD:
            return (program, *(("-u", "-w", str(idle_s)) if udp else ()), "-l", str(port))
        case Netcat.NCAT if udp:
            return (program, "-u", "--recv-only", "-i", str(idle_s), "-l", str(port))
        case Netcat.NCAT:
            return (*_ENDLESS_INPUT, program, "--recv-only", "-l", str(port))
        case Netcat.BUSYBOX:
            return (*_ENDLESS_INPUT, program, *(("-u",) if udp else ()), "-l", "-p", str(port))
        case Netcat.TRADITIONAL:
            return (program, *(("-u",) if udp else ()), "-l", "-p", str(port), *(("-w", str(idle_s)) if udp else ()))


def send(netcat: Netcat, program: str, protocol: Protocol, address: str, port: int) -> tuple[str, ...]:
    """Return the command that sends its standard input to `address` and `port`."""
    leave = {Netcat.NCAT: ("--send-only",), Netcat.BUSYBOX: ()}.get(netcat, ("-q", "0"))
    return (program, *(("-u",) if protocol is Protocol.UDP else ()), *leave, address, str(port))


def sender_cut(code: int | None, log: str | None) -> bool:
    """Return whether a sender that ended with this exit code and these words was ended by a signal.

    Of the others the exit code tells. The traditional one catches signals, writes an empty line and ends with 1;
    where it fails by itself it says why (1.10-47, by hand).
    """
    return code == 1 and log == "\n"


def listener_cut(code: int | None, log: str | None) -> bool:
    """Return whether a listener was ended by a signal, as `sender_cut`, or because it could not write.

    On a full disk (by hand) the traditional one ends with 1 without a word, busybox and ncat with words; OpenBSD's
    ends as if it were done. Who hears nothing for `-w` says so, and ends with 1 or, ncat, 2.
    """
    return code in {1, 2} and log is not None and (not log.strip() or "write" in log)


def cut_short(sender: Netcat, receiver: Netcat, receiver_version: str = "") -> bool:
    """Return whether the receiver reads less of a datagram than the sender puts into one, and drops the rest.

    Args:
        sender: The sender's netcat.
        receiver: The receiver's.
        receiver_version: What the receiver's prints of its version; empty where it is not known.
    """
    both_know_udp = sender in DATAGRAM_BYTES and receiver in _READ_BYTES
    return both_know_udp and DATAGRAM_BYTES[sender] > _read_bytes(receiver, receiver_version)


def _read_bytes(netcat: Netcat, version: str) -> int:
    """Return how much of a datagram a listener reads."""
    numbers = _NCAT_VERSION.search(version)
    if netcat is Netcat.NCAT and numbers and (int(numbers[1]), int(numbers[2])) < _NCAT_CHANGED:
        return _OLD_NCAT_READ_BYTES
    return _READ_BYTES[netcat]
