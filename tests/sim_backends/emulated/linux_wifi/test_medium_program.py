"""The medium program, with a socket pair in place of the kernel, and without hwsim."""

import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from sim_backends.emulated.linux_wifi.hwsim_messages import RadioAddress, RateStage, SentFrame, encode_sent
from sim_backends.emulated.linux_wifi.medium_program import RequestLines, serve
from sim_backends.emulated.linux_wifi.netlink import NetlinkMessage, decode_generic, decode_messages

DEADLINE_S = 120.0
SETUP = {
    "seed": 1,
    "radios": {"r1": {"address": "42:00:00:00:00:00"}, "r2": {"address": "42:00:00:00:01:00"}},
    "options": {"fading": False},
}
PLACE = {"do": "place", "positions": {"r1": [0, 0, 1], "r2": [3, 0, 1]}, "velocities": {}}


class PairedKernel:
    """The program's end of a socket pair; a test writes to the other end as the kernel does."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self.overruns = 0

    def fileno(self) -> int:
        return self._end.fileno()

    def send(self, payload: bytes) -> None:
        self._end.send(payload)

    def receive(self) -> list[NetlinkMessage]:
        try:
            datagram = self._end.recv(1 << 16)
        except BlockingIOError:
            return []
        return list(decode_messages(datagram))


class MediumOwner:
    """The owner of a medium: sends requests, and messages as the kernel does."""

    def __init__(self, kernel: socket.socket, requests: int, replies: int) -> None:
        self.kernel = kernel
        self._requests = requests
        self._replies = os.fdopen(os.dup(replies), "rb")

    def request(self, request: object) -> dict[str, Any]:
        os.write(self._requests, json.dumps(request).encode() + b"\n")
        reply: dict[str, Any] = json.loads(self._replies.readline())
        return reply

    def send_frame(self) -> None:
        content = bytes.fromhex("08010000 020000000100 020000000000") + bytes(100)
        frame = SentFrame(RadioAddress(bytes.fromhex("420000000000")), content, 1, 2437, (RateStage(11, 3),), 9)
        self.kernel.send(NetlinkMessage(0x1C, 0, 0, encode_sent(frame)).encode())

    def close(self) -> None:
        self._replies.close()


@contextmanager
def running_medium() -> Iterator[MediumOwner]:
    """Run a medium in a thread; it must exit when its pipe of requests is closed."""
    kernel_socket, program_socket = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    kernel_socket.settimeout(DEADLINE_S)
    program_socket.setblocking(False)
    request_read, request_write = os.pipe()
    reply_read, reply_write = os.pipe()
    thread = threading.Thread(
        target=serve, args=(PairedKernel(program_socket), RequestLines(request_read), reply_write)
    )
    thread.start()
    owner = MediumOwner(kernel_socket, request_write, reply_read)
    try:
        yield owner
    finally:
        os.close(request_write)
        thread.join(DEADLINE_S)
        assert not thread.is_alive()
        owner.close()
        for fd in (request_read, reply_read, reply_write):
            os.close(fd)
        kernel_socket.close()
        program_socket.close()


def test_a_frame_passes_through_the_program() -> None:
    with running_medium() as owner:
        assert owner.request(SETUP) == {}
        assert owner.request(PLACE) == {}
        owner.send_frame()
        commands = [decode_generic(owner.kernel.recv(1 << 16))[0] for _ in range(2)]
        assert commands == [2, 3]  # the frame to the receiver, then the status to the sender
        totals = owner.request({"do": "totals"})
    (link,) = totals["links"]
    assert (link["transmitter"], link["receiver"], link["acknowledged"], link["tries"]) == ("r1", "r2", 1, 1)
    assert (totals["rejected"], totals["overruns"], totals["errors"]) == (0, 0, {})


def test_frames_before_the_setup_are_discarded_and_bad_bytes_are_counted() -> None:
    with running_medium() as owner:
        owner.send_frame()
        assert "do" in owner.request({"do": "totals"})["error"]
        owner.request(SETUP)
        owner.kernel.send(b"no message")
        owner.send_frame()  # without positions, no radio receives it
        command, status = decode_generic(owner.kernel.recv(1 << 16))
        assert (command, status[7][:2]) == (3, b"\x0b\x03")
        assert owner.request({"do": "totals"})["rejected"] == 1


@pytest.mark.parametrize(
    "request_",
    [
        [],
        {"do": "unknown"},
        {"do": "place", "positions": {"r1": [0, 0]}, "velocities": {}},
        {"do": "place", "positions": {"r1": ["x", 0, 0]}, "velocities": {}},
        {"do": "place", "positions": 5, "velocities": {}},
    ],
)
def test_an_invalid_request_gets_an_error_and_changes_nothing(request_: object) -> None:
    with running_medium() as owner:
        owner.request(SETUP)
        assert owner.request(request_)["error"]
        assert owner.request(PLACE) == {}


@pytest.mark.parametrize("address", ["42:00", "zz:00:00:00:01:00", ""])
def test_a_setup_with_a_wrong_address_is_refused(address: str) -> None:
    with running_medium() as owner:
        assert "is not an address" in owner.request({"seed": 1, "radios": {"r1": {"address": address}}})["error"]
        assert owner.request(SETUP) == {}


def test_a_request_without_end_stops_the_program(tmp_path: Path) -> None:
    endless = tmp_path / "requests"
    endless.write_bytes(b"x" * (1 << 21))
    with endless.open("rb") as requests:
        lines = RequestLines(requests.fileno())
        with pytest.raises(ValueError, match="longer than"):
            read_all_lines(lines)


def read_all_lines(lines: RequestLines) -> list[bytes]:
    all_lines: list[bytes] = []
    while not lines.is_at_end:
        all_lines += lines.read()
    return all_lines


@pytest.mark.skipif(Path("/sys/module/mac80211_hwsim").exists(), reason="this kernel has loaded hwsim")
def test_without_hwsim_the_error_names_the_command_that_loads_it() -> None:
    argv = (sys.executable, "-m", "sim_backends.emulated.linux_wifi.medium_program")
    result = subprocess.run(argv, input="", capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    assert result.returncode == 2
    assert "MAC80211_HWSIM" in result.stderr
    assert "modprobe mac80211_hwsim" in result.stderr
