"""Program in the virtual machine that connects the host to the lab of a folder.

The command is `python -m sim_backends.emulated.linux_wifi.lab_relay PATTERN FOLDER`. PATTERN is a glob pattern of the
channel's device, and FOLDER is the folder in which the lab was started.

Each stream of the channel is one connection to the lab's socket: a request and its answer. The request `login` is
answered from the lab's files. After `connect ROBOT` the stream is a connection to the SSH server of the robot.
"""

import contextlib
import glob
import json
import os
import socket
import sys
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from fieldkit.lab.folder import LabFolder, of_directory
from sim_backends.emulated.linux_wifi.streams import ChannelStreams

CONNECTED: Final = b"+"
"""Answer to `connect ROBOT` before the bytes of the robot; anything else is an error message."""

_REQUEST_S: Final = 20.0
"""Timeout for the request on a stream, and for the lab's answer."""
_START_S: Final = 600.0
"""Timeout for the start of the lab."""
_POLL_S: Final = 0.2
_CHUNK_BYTES: Final = 1 << 15


@dataclass(frozen=True)
class GuestLogin:
    """Answer to `login`.

    Attributes:
        private_key: Private key that logs in on all robots.
        host_keys: Public host key of each robot.
    """

    private_key: str
    host_keys: dict[str, str]


def main(pattern: str, directory: str) -> None:
    """Serve the channel, which is the first device that matches a pattern, until it ends."""
    lab = of_directory(Path(directory))
    _wait_for_login(lab)
    relay(os.open(glob.glob(pattern)[0], os.O_RDWR), lab)  # noqa: PTH207 (an absolute pattern)


def relay(descriptor: int, lab: LabFolder) -> None:
    """Serve the channel of a descriptor until it ends."""
    ChannelStreams(descriptor, lambda stream: serve(stream, lab)).run()


def serve(stream: socket.socket, lab: LabFolder) -> None:
    """Answer the request on a stream; an error of the stream or of the lab's connection ends the stream."""
    with stream, contextlib.suppress(OSError, ValueError):
        stream.settimeout(_REQUEST_S)
        request = _read_line(stream)
        stream.settimeout(None)
        if request == b"login":
            stream.sendall(_login(lab))
            return
        with socket.socket(socket.AF_UNIX) as client:
            client.settimeout(_REQUEST_S)
            client.connect(str(lab.socket))
            client.sendall(request + b"\n")
            if not request.startswith(b"connect "):
                stream.sendall(b"".join(iter(lambda: client.recv(_CHUNK_BYTES), b"")))  # the whole answer
                return
            message, descriptors, _, _ = socket.recv_fds(client, 4096, 1)
        if not descriptors:
            stream.sendall(message)
            return
        with socket.socket(fileno=descriptors[0]) as robot:
            robot.settimeout(None)
            stream.sendall(CONNECTED)
            _copy_both_ways(stream, robot)


def _wait_for_login(lab: LabFolder) -> None:
    """Wait until the lab has written its last file; the files that the host needs to log in are then complete."""
    end_s = time.monotonic() + _START_S
    while not lab.ssh_config.exists():
        if time.monotonic() > end_s:
            sys.exit("the lab did not start")
        time.sleep(_POLL_S)


def _login(lab: LabFolder) -> bytes:
    hosts = dict(line.split(" ", 1) for line in lab.known_hosts.read_text(encoding="utf-8").splitlines())
    return json.dumps(asdict(GuestLogin(lab.key.read_text(encoding="utf-8"), hosts))).encode()


def _read_line(stream: socket.socket) -> bytes:
    line = b""
    while not line.endswith(b"\n"):
        data = stream.recv(4096)
        line += data
        if not data or len(line) > _CHUNK_BYTES:
            raise ValueError("the request is not a line")
    return line[:-1]


def _copy_both_ways(first: socket.socket, second: socket.socket) -> None:
    """Copy the bytes of each socket to the other until both have ended."""
    reverse = threading.Thread(target=_copy, args=(second, first), daemon=True)
    reverse.start()
    _copy(first, second)
    reverse.join()


def _copy(source: socket.socket, destination: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(_CHUNK_BYTES):
            destination.sendall(data)
    with contextlib.suppress(OSError):
        destination.shutdown(socket.SHUT_WR)


if __name__ == "__main__":
    main(*sys.argv[1:])
