"""Record scans, associations, roaming and power save of Linux: `python -m benchmarks.kernel_roaming NAME`, as root.

The program runs in the virtual machine of `roaming_vs_kernel`, with three radios of mac80211_hwsim: the station
`robot` with wpa_supplicant, and the access points `left` and `right` of one hostapd, which are 100 m apart. The
program is their medium, with fieldkit's radio model without fading. It prints one event per line, with the time in
microseconds:

    TIME,air,TRANSMITTER,RECEIVER,KIND,MHZ,BYTES,SLEEPS     a frame, when the kernel has passed it to the medium
    TIME,kernel,EVENT                                       a trace event of mac80211 at the robot
    TIME,mark,TEXT                                          a step of this program

SLEEPS is the power management bit. BYTES includes the FCS.
"""

import re
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from random import Random
from typing import Final, Literal

from fieldkit.core.model import Vector
from sim_backends.emulated.linux_wifi.access_points import BRIDGE, configuration
from sim_backends.emulated.linux_wifi.air import Air
from sim_backends.emulated.linux_wifi.hwsim_medium import HwsimMedium
from sim_backends.emulated.linux_wifi.hwsim_messages import RadioAddress, SentFrame, decode_event, encode_status
from sim_backends.emulated.linux_wifi.hwsim_socket import open_registered
from sim_backends.emulated.linux_wifi.netlink import NLMSG_ERROR
from sim_backends.emulated.linux_wifi.radios import HwsimRadio, find_radios
from sim_backends.emulated.medium.timerfd import Timer
from sim_backends.emulated.robot import wireless
from sim_backends.emulated.robot.spec import WifiSpec
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.radio_options import RadioOptions

Security = Literal["wpa2", "wpa3"]

ROBOT: Final = "robot"
ACCESS_POINTS_M: Final[Mapping[str, Vector]] = {"left": (0.0, 3.0, 2.5), "right": (100.0, 3.0, 2.5)}
NEAR_M, WALK_M, FAR_M = 5.0, 100.0, 90_000.0
"""Positions of the robot on the line along the access points: near the left one, end of a walk, out of range."""
SPEED_M_S: Final = 1.0
HEIGHT_M: Final = 0.2
ROBOT_DBM, ACCESS_POINT_DBM, SENSITIVITY_DBM = 15.0, 20.0, -88.0
CHANNELS: Final = 11
SCANS: Final = {"default": "simple:30:-65:300", "frequent": "simple:3:-55:10"}
"""Background scans of a walk: NetworkManager's, and more frequent ones."""

_PASSPHRASE: Final = "fieldkit-roaming"
_FIRST_MHZ, _STEP_MHZ = 2412, 5
_PLACE_S: Final = 0.2  # interval between positions during a walk
_PACKET_S: Final = 0.02  # interval of packets to the robot during a walk and during scans
_WAIT_S: Final = 60.0  # time limit of each step
_PRIORITY: Final = 0x107
"""Access category VO, which has no block-ACK session."""
_ETHERTYPE: Final = 0x88B5  # for experiments: IEEE 802
_TRACING: Final = Path("/sys/kernel/tracing")
_TRACED: Final = ("drv_sw_scan_start", "drv_sw_scan_complete", "drv_config")
_TRACE_LINE: Final = re.compile(r"\s(\d+\.\d+): (\w+: .*)")
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


def log_trace() -> None:
    """Print the trace events of the kernel since the last call."""
    text = (_TRACING / "trace").read_text(errors="replace")
    for match in _TRACE_LINE.finditer(text):
        log(round(float(match[1]) * 1e6) * 1000, "kernel", match[2].replace(",", " "))
    (_TRACING / "trace").write_text("")


def prepare() -> None:
    """Mount the kernel's trace events, select some, and create the bridge."""
    if not any(_TRACING.iterdir()):
        _run("mount", "-t", "tracefs", "tracefs", str(_TRACING))
    (_TRACING / "trace_clock").write_text("mono")
    for event in _TRACED:
        (_TRACING / "events/mac80211" / event / "enable").write_text("1")
    for name in ("all", "default"):
        Path(f"/proc/sys/net/ipv6/conf/{name}/disable_ipv6").write_text("1")
    _run("ip", "link", "add", "name", BRIDGE, "type", "bridge")
    _run("ip", "address", "add", "10.42.0.1/24", "dev", BRIDGE)
    _run("ip", "link", "set", BRIDGE, "up")


def scan(lab: Lab, *words: str) -> None:
    """Scan with `iw` on all channels."""
    frequencies = [str(_FIRST_MHZ + _STEP_MHZ * number) for number in range(CHANNELS)]
    lab.run_on_robot("iw", "dev", lab.interface, "scan", "freq", *frequencies, *words)
    lab.wait(0.5)


class Downlink:
    """Sends packets to the robot over the bridge of the access points.

    Args:
        lab: The lab.
    """

    def __init__(self, lab: Lab) -> None:
        self._lab = lab
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PRIORITY, _PRIORITY)
        self._socket.bind((BRIDGE, 0))
        self._source = bytes.fromhex(Path(f"/sys/class/net/{BRIDGE}/address").read_text().strip().replace(":", ""))

    def send(self, receiver: bytes) -> None:
        """Send a packet."""
        self._socket.send(receiver + self._source + _ETHERTYPE.to_bytes(2, "big") + bytes(100))

    def send_until(self, condition: Callable[[], bool]) -> None:
        """Send packets to the robot at fixed intervals until a condition is true."""
        next_s = time.monotonic()
        while not condition():
            self.send(self._lab.robot_address)
            next_s += _PACKET_S
            self._lab.wait(next_s - time.monotonic())


def record_scans(lab: Lab, downlink: Downlink, random: Random) -> None:
    """Scan without an association, and during one: without packets, with packets to the robot, and from it."""
    del random
    for words in ((), ("passive",)):
        mark(f"scan {' '.join(words)}")
        scan(lab, *words)
    lab.connect("wpa2", channels=1)
    for words in ((), ("passive",)):
        mark(f"associated scan {' '.join(words)}")
        scan(lab, *words)
    mark("associated scan with packets to the robot")
    frequencies = [str(_FIRST_MHZ + _STEP_MHZ * number) for number in range(CHANNELS)]
    lab.start(f"{ROBOT}-scan", "iw", "dev", lab.interface, "scan", "freq", *frequencies)
    end_s = time.monotonic() + 6
    downlink.send_until(lambda: time.monotonic() > end_s)
    mark("associated scan with packets from the robot")
    lab.start(f"{ROBOT}-ping", "ping", "-i", "0.02", "-q", "10.42.0.1")
    lab.wait(1)
    scan(lab)
    lab.stop(f"{ROBOT}-ping")


def record_associations(lab: Lab, count: int) -> None:
    """Associate again several times."""
    for _ in range(count):
        mark("association")
        lab.reassociate()


def record_lost_frames(lab: Lab) -> None:
    """Associate while the medium loses a frame of the association."""
    for source, kind in (
        (ROBOT, "authentication-1"),
        ("left", "authentication-2"),
        (ROBOT, "reassociation-request"),
        ("left", "reassociation-response"),
        ("left", "eapol-1"),
        (ROBOT, "eapol-2"),
        ("left", "eapol-3"),
        (ROBOT, "eapol-4"),
    ):
        mark(f"loss of {source} {kind}")
        lab.lost.append((source, kind))
        lab.reassociate()
        lab.lost.clear()


def record_link_losses(lab: Lab, random: Random, count: int) -> None:
    """Take the robot out of range until it has lost its link, and back."""
    for _ in range(count):
        lab.wait(random.uniform(0.5, 1.5))
        connections = lab.connections
        mark("out of range")
        lab.place(FAR_M)
        lab.wait_for(lambda: lab.is_disconnected, "loss of the link")
        mark("in range")
        lab.place(NEAR_M)
        lab.wait_for(lambda: lab.connections > connections, "association after the loss of the link")  # noqa: B023


def record_walk(lab: Lab, downlink: Downlink, name: str) -> None:
    """Walk from the left access point to the right one, with packets to the robot."""
    lab.place(0.0)
    lab.connect("wpa2", channels=CHANNELS, scan=SCANS[name])
    lab.wait(2)
    mark(f"walk {name}")
    start_s = time.monotonic()
    placed_s = [start_s]

    def has_arrived() -> bool:
        now_s = time.monotonic()
        if now_s >= placed_s[0] + _PLACE_S:
            placed_s[0] += _PLACE_S
            lab.place(min((now_s - start_s) * SPEED_M_S, WALK_M))
        return (now_s - start_s) * SPEED_M_S > WALK_M

    downlink.send_until(has_arrived)
    mark("arrived")
    lab.place(NEAR_M)


def record_power_save(lab: Lab, downlink: Downlink, random: Random) -> None:
    """Send packets and broadcasts to the robot while it sleeps, and packets that keep it awake."""
    lab.connect("wpa2", channels=1)
    lab.run_on_robot("iw", "dev", lab.interface, "set", "power_save", "on")
    for text, receiver, number in (("packet", lab.robot_address, 150), ("broadcast", b"\xff" * 6, 100)):
        for _ in range(number):
            lab.wait(random.uniform(0.5, 0.9))
            mark(text)
            downlink.send(receiver)
    lab.wait(1)
    for _ in range(20):
        mark("frequent packet")
        downlink.send(lab.robot_address)
        lab.wait(0.05)
    lab.wait(1)


def record_security(lab: Lab, downlink: Downlink, random: Random) -> None:
    """Associate with WPA2, with and without losses, lose the link, and associate with WPA3."""
    del downlink
    lab.connect("wpa2", channels=3)
    record_associations(lab, 5)
    record_lost_frames(lab)
    record_link_losses(lab, random, 12)
    lab.start_access_points("wpa3")
    lab.connect("wpa3", channels=3)


def record_walks(lab: Lab, downlink: Downlink, random: Random) -> None:
    """Walk with each kind of background scan."""
    del random
    for name in SCANS:
        record_walk(lab, downlink, name)


RECORDINGS: Final[Mapping[str, Callable[[Lab, Downlink, Random], None]]] = {
    "scans": record_scans,
    "associations": record_security,
    "walks": record_walks,
    "power-save": record_power_save,
}
"""The recordings by name; each has a separate virtual machine."""


def main() -> None:
    """Make the recording that the command line names."""
    prepare()
    lab = Lab(find_radios()[:3])
    lab.start_access_points("wpa2")
    RECORDINGS[sys.argv[1]](lab, Downlink(lab), Random(1))
    log_trace()
    for name in (f"{ROBOT}-station", "hostapd"):
        lab.stop(name)


def _run(*argv: str) -> None:
    subprocess.run(argv, check=True)


if __name__ == "__main__":
    main()
