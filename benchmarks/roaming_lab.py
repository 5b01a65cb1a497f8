"""The lab of `kernel_roaming`: a robot, two access points, and their medium, in a virtual machine with Linux.

The robot is a station with wpa_supplicant. The access points `left` and `right` of one hostapd are 100 m apart. The
three radios are those of mac80211_hwsim, and their medium is fieldkit's radio model without fading. The lab prints
one event per line, with the time in microseconds; `kernel_roaming` describes the lines.
"""

import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final, Literal

from fieldkit.core.model import Vector
from sim_backends.emulated.linux_wifi.access_points import configuration
from sim_backends.emulated.linux_wifi.air import Air
from sim_backends.emulated.linux_wifi.hwsim_medium import HwsimMedium
from sim_backends.emulated.linux_wifi.hwsim_messages import RadioAddress, SentFrame, decode_event, encode_status
from sim_backends.emulated.linux_wifi.hwsim_socket import open_registered
from sim_backends.emulated.linux_wifi.netlink import NLMSG_ERROR
from sim_backends.emulated.linux_wifi.radios import HwsimRadio
from sim_backends.emulated.medium.timerfd import Timer
from sim_backends.emulated.robot import wireless
from sim_backends.emulated.robot.spec import WifiSpec
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.radio_options import RadioOptions

Security = Literal["wpa2", "wpa3"]

ROBOT: Final = "robot"
ACCESS_POINTS_M: Final[Mapping[str, Vector]] = {"left": (0.0, 3.0, 2.5), "right": (100.0, 3.0, 2.5)}
NEAR_M: Final = 5.0
"""Position of the robot near the left access point, on the line along the access points."""
HEIGHT_M: Final = 0.2
ROBOT_DBM, ACCESS_POINT_DBM, SENSITIVITY_DBM = 15.0, 20.0, -88.0

_PASSPHRASE: Final = "fieldkit-roaming"
_WAIT_S: Final = 60.0  # time limit of each step
_SUBTYPES: Final = {
    0: "association-request",
    1: "association-response",
    2: "reassociation-request",
    3: "reassociation-response",
    4: "probe-request",
    5: "probe-response",
    8: "beacon",
    10: "disassociation",
    11: "authentication",
    12: "deauthentication",
    13: "action",
}


def frame_kind(frame: bytes) -> str:
    """Return the kind of a frame, for example `authentication-1` (with the transaction) or `eapol-2`."""
    subtype = frame[0] >> 4
    if not frame[0] & 0x0C:
        name = _SUBTYPES.get(subtype, f"management-{subtype}")
        return f"{name}-{frame[26]}" if name == "authentication" else name
    if frame[0] & 0x0C != 0x08:
        return f"control-{subtype}"
    if subtype & 0x4:
        return "null"
    body = frame[26 if subtype & 0x8 else 24 :]
    if frame[1] & 0x40 or body[6:8] != b"\x88\x8e":
        return "data"
    flags = int.from_bytes(body[13:15], "big")
    is_from_access_point, has_mic, is_secure = flags & 0x80, flags & 0x100, flags & 0x200
    if is_from_access_point:
        return "eapol-3" if has_mic else "eapol-1"
    return "eapol-4" if is_secure else "eapol-2"


class Lab:
    """The radios, their medium, and the programs of the robot and of the access points.

    Args:
        radios: The radios: robot, left, right.

    Attributes:
        lost: Transmitter and kind of the next frames that the medium loses.
    """

    def __init__(self, radios: Sequence[HwsimRadio]) -> None:
        self._kernel = open_registered()
        self._timer = Timer()
        names = (ROBOT, *ACCESS_POINTS_M)
        self._radios = dict(zip(names, radios, strict=True))
        self._addresses = {
            RadioAddress(bytes.fromhex(radio.address.replace(":", ""))): name for name, radio in self._radios.items()
        }
        self._name_of_interface = {
            bytes((address[0] & ~0x40,)) + address[1:]: name for address, name in self._addresses.items()
        }
        antennas = {
            name: Antenna("802.11n", ROBOT_DBM if name == ROBOT else ACCESS_POINT_DBM, SENSITIVITY_DBM)
            for name in names
        }
        self._medium = HwsimMedium(Air(1, RadioOptions(fading=False), antennas), self._addresses)
        self._epoll = select.epoll()
        self._epoll.register(self._timer.fd, select.EPOLLIN | select.EPOLLET)
        self._epoll.register(self._kernel.fileno(), select.EPOLLIN)
        self._folder = Path(tempfile.mkdtemp())
        self._programs: dict[str, subprocess.Popen[bytes]] = {}
        self.lost: list[tuple[str, str]] = []
        self.place(NEAR_M)
        self._namespace = subprocess.Popen(
            ("unshare", "--net", "sh", "-c", "ip link set lo up; echo; exec sleep infinity"), stdout=subprocess.PIPE
        )
        assert self._namespace.stdout is not None
        self._namespace.stdout.readline()
        radios[0].move_to_namespace(self._namespace.pid)
        self.run_on_robot("nft", "-f", "-", text=wireless.priority_rules(radios[0].interface))
        self.run_on_robot("ip", "link", "set", radios[0].interface, "up")
        self.run_on_robot("ip", "address", "add", "10.42.0.2/24", "dev", radios[0].interface)

    # The medium

    def poll(self, timeout_s: float) -> None:
        """Process events of the air, and wait for the next one at most for this time."""
        next_ns = self._medium.air.next_event_ns()
        if next_ns is not None:
            self._timer.set(next_ns)
        self._epoll.poll(timeout_s)
        now_ns = time.monotonic_ns()
        for message in self._kernel.receive():
            event = None if message.type == NLMSG_ERROR else decode_event(message.payload)
            if isinstance(event, SentFrame) and self._is_lost(now_ns, event):
                continue
            self._medium.receive(now_ns, message)
        for reply in self._medium.replies(now_ns):
            self._kernel.send(reply)

    def _is_lost(self, now_ns: int, event: SentFrame) -> bool:
        """Log a frame; return True if it is lost, which is reported to its transmitter."""
        source = self._addresses[event.radio]
        receiver = self._name_of_interface.get(event.receiver, "*")
        kind = frame_kind(event.frame)
        fields = (source, receiver, kind, event.frequency_mhz, len(event.frame) + 4, event.frame[1] >> 4 & 1)
        log(now_ns, "air", *fields)
        if (source, kind) not in self.lost:
            return False
        self.lost.remove((source, kind))
        mark(f"lost {source} {kind}")
        self._kernel.send(encode_status(event, tries=[event.stages[0].tries], acknowledged=False, signal_dbm=-120))
        return True

    def wait(self, seconds: float) -> None:
        """Run the medium for this time."""
        end_s = time.monotonic() + seconds
        while (remaining_s := end_s - time.monotonic()) > 0:
            self.poll(remaining_s)

    def wait_for(self, condition: Callable[[], bool], what: str) -> None:
        """Run the medium until a condition is true; exit if it is not true in time."""
        end_s = time.monotonic() + _WAIT_S
        while not condition():
            self.poll(0.05)
            if time.monotonic() > end_s:
                sys.exit(f"{what}: no success\n" + "\n".join(self._log(name)[-3000:] for name in self._programs))

    def place(self, east_m: float) -> None:
        """Place the robot on the line along the access points."""
        positions_m = {**ACCESS_POINTS_M, ROBOT: (east_m, 0.0, HEIGHT_M)}
        self._medium.air.place(time.monotonic_ns(), positions_m)

    # Programs

    def start(self, name: str, *argv: str) -> None:
        """Start a program with a log file; on the robot, if its name starts with `robot`."""
        self.stop(name)
        prefix = ("nsenter", "-t", str(self._namespace.pid), "-n") if name.startswith(ROBOT) else ()
        with (self._folder / f"{name}.log").open("wb") as file:
            self._programs[name] = subprocess.Popen((*prefix, *argv), stdout=file, stderr=file)

    def stop(self, name: str) -> None:
        """Stop a program, if it runs."""
        program = self._programs.pop(name, None)
        if program is not None:
            program.terminate()
            while program.poll() is None:
                self.poll(0.05)

    def run_on_robot(self, *argv: str, text: str = "") -> str:
        """Return the output of a program in the robot's network, which must succeed, while the medium runs."""
        with tempfile.TemporaryFile() as stdin, tempfile.TemporaryFile() as stdout:
            stdin.write(text.encode())
            stdin.seek(0)
            program = subprocess.Popen(
                ("nsenter", "-t", str(self._namespace.pid), "-n", *argv), stdin=stdin, stdout=stdout, stderr=stdout
            )
            self.wait_for(lambda: program.poll() is not None, argv[0])
            stdout.seek(0)
            output = stdout.read().decode()
        if program.returncode:
            sys.exit(f"{argv} failed: {output}")
        return output

    def start_access_points(self, security: Security) -> None:
        """Start hostapd and wait until both access points are on."""
        files = []
        for number, name in enumerate(ACCESS_POINTS_M):
            files.append(str(self._folder / f"{name}.conf"))
            wifi = WifiSpec("access point", _PASSPHRASE, security)
            Path(files[-1]).write_text(configuration(self._radios[name].interface, wifi, number), encoding="ascii")
        self.start("hostapd", "hostapd", "-t", *files)
        self.wait_for(lambda: self._log("hostapd").count("AP-ENABLED") == len(files), "hostapd")

    def connect(self, security: Security, *, channels: int, scan: str = "") -> None:
        """Start wpa_supplicant and wait until the robot is associated."""
        wifi = WifiSpec("station", _PASSPHRASE, security, background_scan=scan, channels=channels)
        text = wireless.configuration(self._radios[ROBOT].interface, wifi)
        file = self._folder / "station.conf"
        file.write_text(f"ctrl_interface={self._folder}/control\n{text}", encoding="ascii")
        self.start(f"{ROBOT}-station", "wpa_supplicant", "-t", "-i", self.interface, "-c", str(file))
        self.wait_for(lambda: self.connections == 1, "wpa_supplicant")
        self.wait(1)

    def reassociate(self) -> None:
        """Scan and associate again; wait until the association is complete."""
        count = self.connections
        self.run_on_robot("wpa_cli", "-p", f"{self._folder}/control", "-i", self.interface, "reassociate")
        self.wait_for(lambda: self.connections > count, "reassociate")
        self.wait(0.5)

    @property
    def interface(self) -> str:
        """The robot's interface."""
        return self._radios[ROBOT].interface

    @property
    def connections(self) -> int:
        """Number of associations that wpa_supplicant has completed since its start."""
        return self._log(f"{ROBOT}-station").count("CTRL-EVENT-CONNECTED")

    @property
    def is_disconnected(self) -> bool:
        """True if wpa_supplicant's last event is the loss of the link."""
        text = self._log(f"{ROBOT}-station")
        return text.rfind("CTRL-EVENT-DISCONNECTED") > text.rfind("CTRL-EVENT-CONNECTED")

    @property
    def robot_address(self) -> bytes:
        """Address of the robot's interface."""
        return next(address for address, name in self._name_of_interface.items() if name == ROBOT)

    def _log(self, name: str) -> str:
        return (self._folder / f"{name}.log").read_text(errors="replace")


def log(now_ns: int, *fields: object) -> None:
    """Print an event."""
    sys.stdout.write(",".join(map(str, (now_ns // 1000, *fields))) + "\n")


def mark(text: str) -> None:
    """Print a step of this program."""
    log(time.monotonic_ns(), "mark", text)
