"""A real transfer between each pair of netcats: the file arrives, and both ends end by themselves."""

import shutil
import subprocess
import time
from functools import cache
from itertools import product
from pathlib import Path

import pytest

from fieldkit.core.model import Protocol
from fieldkit.steps import netcat
from fieldkit.steps.variants import Netcat
from tests.helpers.sshd import free_port

pytestmark = pytest.mark.emulated

LIMIT_S = 60.0
IDLE_S = 3
"""How long a listener waits for the first datagram, and after the last."""
# More than a pipe and both socket buffers hold: the sender must wait for the reader.
TCP_BYTES = 24_000_000
# Less than a socket buffer holds: on the loopback nothing else paces UDP.
UDP_BYTES = 60_001

UDP = list(product(netcat.DATAGRAM_BYTES, repeat=2))


@cache
def version(kind: Netcat) -> str:
    """Return what a netcat of this machine prints of its version; the others than ncat have nothing for it."""
    words = ("ncat", "--version")
    return subprocess.run(words, capture_output=True, text=True, check=True).stderr if kind is Netcat.NCAT else ""


def program(kind: Netcat, folder: Path) -> str:
    """The program of that kind, by the name that it goes by."""
    if kind is Netcat.BUSYBOX:
        link = folder / "nc"
        if not link.is_symlink():
            link.symlink_to(shutil.which("busybox") or "busybox is missing")
        return str(link)
    return {Netcat.TRADITIONAL: "nc.traditional", Netcat.OPENBSD: "nc.openbsd", Netcat.NCAT: "ncat"}[kind]


def wait_for_listener(protocol: Protocol, port: int) -> None:
    """Return when a socket is bound to `port`, as the robot's job script sees it."""
    state = "0A" if protocol is Protocol.TCP else "07"
    ends = time.monotonic() + LIMIT_S
    tables = [Path(f"/proc/net/{protocol}{version}") for version in ("", "6")]
    while not any(f":{port:04X} " in line and f" {state} " in line for one in tables for line in one.open()):
        assert time.monotonic() < ends, f"nothing listens on {port}"
        time.sleep(0.01)


def transfer(sender: Netcat, receiver: Netcat, protocol: Protocol, content: bytes, folder: Path) -> bytes:
    """Send `content`, read it slowly, and return what arrived when both ends had ended."""
    port = free_port()
    (folder / "sent").write_bytes(content)
    listen = netcat.listen(receiver, program(receiver, folder), protocol, port, IDLE_S)
    send = netcat.send(sender, program(sender, folder), protocol, "127.0.0.1", port)
    with (
        (folder / "sent").open("rb") as source,
        subprocess.Popen(listen, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, cwd=folder) as listener,
    ):
        try:
            wait_for_listener(protocol, port)
            with subprocess.Popen(send, stdin=source, stdout=subprocess.DEVNULL, cwd=folder) as sending:
                try:
                    received, _ = listener.communicate(timeout=LIMIT_S)
                    assert sending.wait(LIMIT_S) == 0
                finally:
                    sending.kill()
        finally:
            listener.kill()
    return received


@pytest.mark.parametrize(("sender", "receiver"), list(product(Netcat, repeat=2)))
def test_tcp_delivers_the_whole_file(sender: Netcat, receiver: Netcat, tmp_path: Path) -> None:
    content = bytes(range(256)) * (TCP_BYTES // 256)
    assert transfer(sender, receiver, Protocol.TCP, content, tmp_path) == content
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != "nc") == ["sent"]


@pytest.mark.parametrize(("sender", "receiver"), UDP)
def test_udp_delivers_the_whole_file_or_the_pair_is_refused(sender: Netcat, receiver: Netcat, tmp_path: Path) -> None:
    content = (bytes(range(256)) * (UDP_BYTES // 256 + 1))[:UDP_BYTES]
    whole = transfer(sender, receiver, Protocol.UDP, content, tmp_path) == content
    assert whole != netcat.cut_short(sender, receiver, version(receiver))


def test_a_pair_that_is_refused_would_lose_half_of_the_file(tmp_path: Path) -> None:
    received = transfer(Netcat.OPENBSD, Netcat.TRADITIONAL, Protocol.UDP, b"x" * 4 * 16384, tmp_path)
    assert len(received) == 4 * 8192
