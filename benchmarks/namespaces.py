"""Network namespaces without robots for benchmarks and tests; they end with the thread that created them."""

import ctypes
import os
import subprocess
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final, Self

from sim_backends.emulated.robot.tun_devices import open_tun

_ROOT: Final = Path(__file__).resolve().parents[1]
_LIBC: Final = ctypes.CDLL(None, use_errno=True)
_CLONE_NEWNET: Final = 0x40000000  # linux/sched.h


class Namespace:
    """A network namespace; use as a context manager.

    A process keeps the namespace open. It is killed when the thread that created it exits.
    """

    def __init__(self) -> None:
        script = "ip link set lo up && echo ready && exec sleep infinity"
        self._holder = subprocess.Popen(
            ["setpriv", "--pdeathsig", "KILL", "--", "unshare", "--net", "--", "sh", "-c", script],
            stdout=subprocess.PIPE,
        )
        assert self._holder.stdout is not None
        if self._holder.stdout.readline() != b"ready\n":
            self.close()
            raise RuntimeError("no network namespace: this needs root")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """The process that keeps the namespace open."""
        return self._holder.pid

    def inside(self, argv: Sequence[str]) -> list[str]:
        """Return the command that runs `argv` in the namespace."""
        return ["nsenter", f"--net=/proc/{self.pid}/ns/net", "--", *argv]

    def run(self, *argv: str, timeout_s: float = 20.0) -> subprocess.CompletedProcess[str]:
        """Run a command in the namespace to its end, and do not check its exit code."""
        return subprocess.run(
            self.inside(argv), capture_output=True, text=True, timeout=timeout_s, check=False, cwd=_ROOT
        )

    def ip(self, *words: str) -> None:
        """Run `ip` in the namespace; raises `CalledProcessError` if it fails."""
        self.run("ip", *words).check_returncode()

    def start(self, *argv: str, pass_fds: Sequence[int] = ()) -> subprocess.Popen[str]:
        """Start a command in the namespace with a pipe as its output."""
        return subprocess.Popen(self.inside(argv), stdout=subprocess.PIPE, text=True, pass_fds=pass_fds, cwd=_ROOT)

    def tun(self, name: str, address: str) -> int:
        """Create the TUN interface `name` in the namespace, bring it up with `address`, return its descriptor."""
        with ThreadPoolExecutor(1) as executor:
            fd = executor.submit(self._open_tun, name).result()
        self.ip("address", "add", address, "dev", name)
        self.ip("link", "set", name, "up")
        return fd

    def _open_tun(self, name: str) -> int:
        """Create a TUN interface. The calling thread joins the namespace, so it must exit afterwards."""
        with Path(f"/proc/{self.pid}/ns/net").open("rb") as namespace:
            if _LIBC.setns(namespace.fileno(), _CLONE_NEWNET):
                number = ctypes.get_errno()
                raise OSError(number, os.strerror(number))
        return open_tun(name)

    def veth(self, peer: "Namespace", address: str, peer_address: str) -> None:
        """Connect this namespace with `peer` by a veth pair, both ends named `wire0`."""
        self.ip("link", "add", "wire0", "type", "veth", "peer", "name", "wire0", "netns", str(peer.pid))
        for end, end_address in ((self, address), (peer, peer_address)):
            end.ip("address", "add", end_address, "dev", "wire0")
            end.ip("link", "set", "wire0", "up")

    def close(self) -> None:
        """Kill the holder, which removes an otherwise empty namespace; a second call has no effect."""
        self._holder.kill()
        self._holder.wait()
        if self._holder.stdout is not None:
            self._holder.stdout.close()
