"""Two hosts on one cable: network namespaces with a veth pair, which end with the processes that hold them."""

import subprocess
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Final

ADDRESSES: Final = ("10.99.0.1", "10.99.0.2")


@dataclass(frozen=True)
class TestHost:
    """One of them.

    Attributes:
        address: Its address on the cable.
        pid: Of the process that holds its namespace.
    """

    __test__ = False

    address: str
    pid: int

    @contextmanager
    def start(self, argv: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
        """Run a command there; what still runs behind the body is ended."""
        with subprocess.Popen(("nsenter", "-t", str(self.pid), "-n", *argv), stderr=subprocess.PIPE) as process:
            try:
                yield process
            finally:
                process.kill()


@contextmanager
def cabled() -> Iterator[tuple[TestHost, TestHost]]:
    """Give two hosts on one cable."""
    with ExitStack() as stack:
        near, far = (stack.enter_context(_namespace()) for _ in ADDRESSES)
        _ip(near, "link", "add", "radio0", "type", "veth", "peer", "name", "radio0", "netns", str(far))
        for pid, address in zip((near, far), ADDRESSES, strict=True):
            _ip(pid, "addr", "add", f"{address}/24", "dev", "radio0")
            for device in ("lo", "radio0"):
                _ip(pid, "link", "set", device, "up")
            _ip(pid, "route", "add", "224.0.0.0/4", "dev", "radio0")
        yield TestHost(ADDRESSES[0], near), TestHost(ADDRESSES[1], far)


@contextmanager
def _namespace() -> Iterator[int]:
    """Give the process that holds a network namespace of its own."""
    holder = subprocess.Popen(
        ("unshare", "--net", "sh", "-c", "echo up; exec cat"), stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    with holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"up\n"
        yield holder.pid
        assert holder.stdin is not None
        holder.stdin.close()


def _ip(pid: int, *words: str) -> None:
    subprocess.run(("nsenter", "-t", str(pid), "-n", "ip", *words), check=True)
