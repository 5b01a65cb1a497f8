"""Two hosts on one cable: network namespaces with a veth pair; a namespace is removed when its process exits."""

import subprocess
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Final

ADDRESSES: Final = ("10.99.0.1", "10.99.0.2")


@dataclass(frozen=True)
class TestHost:
    """A host.

    Attributes:
        address: Its address on the cable.
        pid: The id of the process that keeps its namespace.
    """

    __test__ = False

    address: str
    pid: int

    @contextmanager
    def start(self, argv: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
        """Run a command on the host; kill it at the end of the body if it still runs."""
        with subprocess.Popen(("nsenter", "-t", str(self.pid), "-n", *argv), stderr=subprocess.PIPE) as process:
            try:
                yield process
            finally:
                process.kill()


@contextmanager
def two_connected_hosts() -> Iterator[tuple[TestHost, TestHost]]:
    """Yield two hosts on one cable."""
    with ExitStack() as stack:
        first, second = (stack.enter_context(_namespace()) for _ in ADDRESSES)
        _ip(first, "link", "add", "radio0", "type", "veth", "peer", "name", "radio0", "netns", str(second))
        for pid, address in zip((first, second), ADDRESSES, strict=True):
            _ip(pid, "addr", "add", f"{address}/24", "dev", "radio0")
            for device in ("lo", "radio0"):
                _ip(pid, "link", "set", device, "up")
            _ip(pid, "route", "add", "224.0.0.0/4", "dev", "radio0")
        yield TestHost(ADDRESSES[0], first), TestHost(ADDRESSES[1], second)


@contextmanager
def _namespace() -> Iterator[int]:
    """Yield the id of a process that keeps a new network namespace."""
    holder = subprocess.Popen(
        ("unshare", "--net", "sh", "-c", "echo up; exec cat"), stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    with holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"up\n"
        yield holder.pid
        assert holder.stdin is not None
        holder.stdin.close()


def _ip(pid: int, *arguments: str) -> None:
    subprocess.run(("nsenter", "-t", str(pid), "-n", "ip", *arguments), check=True)
