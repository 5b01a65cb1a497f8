"""Addresses of all transports on this machine, and the ROS master that one of them needs."""

import os
import secrets
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final

import pytest

from tests.helpers.sshd import free_port

SCHEMES: Final = ("tcp", "udp", "dds", "ros1")


def new_addresses(scheme: str) -> tuple[str, str]:
    """Return an unused address of a transport, once for the federate that listens and once for the coordinator."""
    if scheme in {"dds", "ros1"}:
        address = f"{scheme}:test_{secrets.token_hex(4)}"
        return address, address
    port = free_port()
    return f"{scheme}-listen:127.0.0.1:{port}", f"{scheme}:127.0.0.1:{port}"


@contextmanager
def ros_master() -> Iterator[str]:
    """Run a ROS master, set `ROS_MASTER_URI` to its URI, and yield the URI."""
    port = free_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_MASTER_URI", f"http://127.0.0.1:{port}")
        patch.setenv("ROS_IP", "127.0.0.1")
        environment = os.environ | {"ROS_LOG_DIR": "/tmp"}
        process = subprocess.Popen(
            ("rosmaster", "--core", "-p", str(port)),
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            _wait_for_port(process, port)
            yield f"http://127.0.0.1:{port}"
        finally:
            process.terminate()
            process.wait()


def _wait_for_port(process: "subprocess.Popen[bytes]", port: int) -> None:
    deadline_s = time.monotonic() + 60
    while time.monotonic() < deadline_s and process.poll() is None:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
            return
        time.sleep(0.01)
    raise AssertionError("rosmaster does not listen")
