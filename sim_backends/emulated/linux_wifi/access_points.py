"""Access points of Linux that are not robots.

They are radios of mac80211_hwsim (the kernel's simulated radios) in one network namespace, with hostapd and a bridge.
Through the bridge, stations of different access points reach each other.
"""

import subprocess
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import RobotError, TestbedLostError
from sim_backends.emulated.linux_wifi.radios import HwsimRadio
from sim_backends.emulated.process.worker import PATH
from sim_backends.emulated.robot import wireless
from sim_backends.emulated.robot.spec import WifiSpec

BRIDGE: Final = "fieldkit"
_START: Final = """\
read -r _
for name in all default; do echo 1 >/proc/sys/net/ipv6/conf/$name/disable_ipv6; done
nft -f rules || exit
ip link add name {bridge} type bridge && ip link set {bridge} up || exit
exec hostapd {files}
"""
"""Shell script of the process; it waits for an input line, which is sent when the radios are in its namespace."""
_BEACON_INTERVALS_TU: Final = (100, 101, 103, 107, 109, 113)
"""Intervals of the beacons in time units (1024 us); the seventh access point has the first interval again.

They differ because mac80211_hwsim derives the times of beacons from one clock: beacons of equal intervals would
always collide.
"""
_ENABLED: Final = "AP-ENABLED"
_START_S: Final = 60.0
"""Timeout for the start of all access points."""
_EXIT_S: Final = 5.0
"""Time for hostapd to exit at a signal before it is killed."""
_POLL_S: Final = 0.1


class AccessPoints:
    """The access points of one network, which run until `close`.

    The process starts when the object is created. The kernel kills it when the thread that created the object ends.

    Args:
        radios: Radio of each access point, by its name.
        wifi: Wi-Fi settings of a station of the network, with the passphrase.

    Raises:
        RobotError: The kernel or hostapd refused a setting.
    """

    def __init__(self, radios: Mapping[str, HwsimRadio], wifi: WifiSpec) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="fieldkit-access-points-")
        folder = Path(self._folder.name)
        files = []
        for number, radio in enumerate(radios.values()):
            files.append(f"{number}.conf")
            (folder / files[-1]).write_text(configuration(radio.interface, wifi, number), encoding="ascii")
        (folder / "rules").write_text(wireless.priority_rules(*(radio.interface for radio in radios.values())))
        self._log = folder / "hostapd.log"
        argv = ("setpriv", "--pdeathsig", "KILL", "--", "unshare", "--net", "--", "sh", "-c")
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                (*argv, _START.format(files=" ".join(files), bridge=BRIDGE)),
                cwd=folder,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env={"PATH": PATH},
            )
        try:
            self._start(radios)
        except BaseException:
            self.close()
            raise

    def check_alive(self) -> None:
        """Raise TestbedLostError if hostapd has ended."""
        if self._process.poll() is not None:
            raise TestbedLostError(f"hostapd of the access points has ended: {self._last_line()}", remedy="try again")

    def close(self) -> None:
        """Stop hostapd and wait until it has exited; a second call does nothing.

        The kernel then moves the radios to the initial network namespace.
        """
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_EXIT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._folder.cleanup()

    def _start(self, radios: Mapping[str, HwsimRadio]) -> None:
        """Move the radios to the process, and return when every access point is on."""
        deadline = Deadline.after(_START_S)
        namespaces = [Path(f"/proc/{pid}/ns/net") for pid in ("self", self._process.pid)]
        while len({path.readlink() for path in namespaces}) < len(namespaces):  # until it has its own namespace
            self._wait(deadline)
        for radio in radios.values():
            radio.move_to_namespace(self._process.pid)
        assert self._process.stdin is not None
        self._process.stdin.write(b"\n")
        self._process.stdin.flush()
        while self._log.read_text(encoding="utf-8", errors="replace").count(_ENABLED) < len(radios):
            self._wait(deadline)

    def _wait(self, deadline: Deadline) -> None:
        if self._process.poll() is not None or deadline.expired:
            raise RobotError(f"the access points did not start: {self._last_line()}", remedy="update hostapd")
        time.sleep(_POLL_S)

    def _last_line(self) -> str:
        return self._log.read_text(encoding="utf-8", errors="replace").strip().rpartition("\n")[2]


def configuration(interface: str, wifi: WifiSpec, number: int) -> str:
    """Return the configuration of hostapd for the access point of this number in a network with a bridge."""
    interval_tu = _BEACON_INTERVALS_TU[number % len(_BEACON_INTERVALS_TU)]
    common = wireless.configuration(interface, replace(wifi, mode="access point"))
    return f"{common}bridge={BRIDGE}\nbeacon_int={interval_tu}\n"
