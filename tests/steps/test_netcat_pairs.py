"""Transfers between all pairs of variants of netcat: the file arrives, and both ends exit."""

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
"""Time in which a listener waits for the first datagram, and for a further datagram after the last."""
# Larger than a pipe and both socket buffers, so that the sender must wait for the reader.
TCP_BYTES = 24_000_000
# Smaller than a socket buffer, because nothing limits the rate of UDP on loopback.
UDP_BYTES = 60_001

UDP = list(product(netcat.DATAGRAM_BYTES, repeat=2))


@cache
def version(kind: Netcat) -> str:
    """Return the version text of ncat on this machine; the other variants print none, so theirs is empty."""
    argv = ("ncat", "--version")
    return subprocess.run(argv, capture_output=True, text=True, check=True).stderr if kind is Netcat.NCAT else ""


def program(kind: Netcat, folder: Path) -> str:
    """Return the command of a variant."""
    if kind is Netcat.BUSYBOX:
        link = folder / "nc"
        if not link.is_symlink():
            link.symlink_to(shutil.which("busybox") or "busybox is missing")
        return str(link)
    return {Netcat.TRADITIONAL: "nc.traditional", Netcat.OPENBSD: "nc.openbsd", Netcat.NCAT: "ncat"}[kind]


def wait_for_listener(protocol: Protocol, port: int) -> None:
    """Wait until a socket is bound to `port`, as the robot's job script does."""
    state = "0A" if protocol is Protocol.TCP else "07"
    end_s = time.monotonic() + LIMIT_S
    tables = [Path(f"/proc/net/{protocol}{version}") for version in ("", "6")]
    while not any(f":{port:04X} " in line and f" {state} " in line for table in tables for line in table.open()):
        assert time.monotonic() < end_s, f"nothing listens on {port}"
        time.sleep(0.01)


def transfer(sender: Netcat, receiver: Netcat, protocol: Protocol, content: bytes, folder: Path) -> bytes:
    """Send `content`, read it slowly, and return the received bytes after both ends have exited."""
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
            with subprocess.Popen(send, stdin=source, stdout=subprocess.DEVNULL, cwd=folder) as sender_process:
                try:
                    received_data, _ = listener.communicate(timeout=LIMIT_S)
                    assert sender_process.wait(LIMIT_S) == 0
                finally:
                    sender_process.kill()
        finally:
            listener.kill()
    return received_data


@pytest.mark.parametrize(("sender", "receiver"), list(product(Netcat, repeat=2)))
def test_tcp_delivers_complete_file(sender: Netcat, receiver: Netcat, tmp_path: Path) -> None:
    content = bytes(range(256)) * (TCP_BYTES // 256)
    assert transfer(sender, receiver, Protocol.TCP, content, tmp_path) == content
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != "nc") == ["sent"]


@pytest.mark.parametrize(("sender", "receiver"), UDP)
def test_udp_delivers_complete_file_or_the_pair_is_refused(sender: Netcat, receiver: Netcat, tmp_path: Path) -> None:
    content = (bytes(range(256)) * (UDP_BYTES // 256 + 1))[:UDP_BYTES]
    is_complete = transfer(sender, receiver, Protocol.UDP, content, tmp_path) == content
    assert is_complete != netcat.truncates_datagrams(sender, receiver, version(receiver))


def test_refused_pair_loses_half_of_the_file(tmp_path: Path) -> None:
    received_data = transfer(Netcat.OPENBSD, Netcat.TRADITIONAL, Protocol.UDP, b"x" * 4 * 16384, tmp_path)
    assert len(received_data) == 4 * 8192
