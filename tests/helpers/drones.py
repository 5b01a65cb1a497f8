"""A drone that a test connects to over a socket or a terminal, and synthetic telemetry logs."""

import os
import random
import select
import selectors
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from pymavlink.dialects.v20 import common as d

from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from sim_backends.emulated.autopilot.autopilot import Autopilot
from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.px4 import PX4
from sim_backends.physics.ground import Ground
from sim_backends.physics.robot_limits import DUCKIEDRONE
from tests.helpers.ground_station import LIMITS

SYSTEM: Final = 7
PEER: Final = ("gcs", 1)
"""The name of the peer to which the drone attributes all received data."""
START_US: Final = 1_795_000_000_000_000
"""A time in November 2026."""

Damage = Callable[[bytes], Iterable[bytes]]
"""Returns the data that is sent in place of a frame."""


class Sender:
    """Packs messages into frames, as one component does.

    Args:
        system: Its system id.
        component: Its component id.
    """

    def __init__(self, system: int = SYSTEM, component: int = 1) -> None:
        self.link = d.MAVLink(None, srcSystem=system, srcComponent=component)

    def frame(self, message: Any) -> bytes:  # noqa: ANN401 (of pymavlink)
        packed: bytes = message.pack(self.link)
        self.link.seq = (self.link.seq + 1) % 256
        return packed


def stamped(frames: Iterable[tuple[int, bytes]]) -> bytes:
    """A telemetry log of frames with their times in us after `START_US`."""
    return b"".join(struct.pack(">Q", START_US + at_us) + frame for at_us, frame in frames)


def beat(*, armed: bool = False) -> Any:  # noqa: ANN401
    mode = d.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
    return d.MAVLink_heartbeat_message(d.MAV_TYPE_QUADROTOR, d.MAV_AUTOPILOT_PX4, mode, 0, d.MAV_STATE_ACTIVE, 3)


def flight(seconds: float = 10.0, speed_m_s: float = 1.0, lost: Callable[[int], bool] = lambda _: False) -> bytes:
    """The log of a drone that flies north at a height of 3 m, facing north, with 10 messages a second."""
    sender, frames = Sender(), []
    frames.append((0, sender.frame(beat(armed=True))))
    for number in range(round(10 * seconds) + 1):
        at_ms = 100 * number
        ahead_m = speed_m_s * at_ms / 1e3
        for message in (
            d.MAVLink_attitude_message(at_ms, 0.1, -0.2, 0.0, 0, 0, 0),
            d.MAVLink_local_position_ned_message(at_ms, ahead_m, 0, -3.0, speed_m_s, 0, 0.0),
        ):
            frame = sender.frame(message)
            if not lost(number):
                frames.append((at_ms * 1000 + 500, frame))
    return stamped(frames)


@contextmanager
def flying(
    descriptor: int,
    send: Callable[[bytes], object],
    receive: Callable[[int], bytes],
    firmware: Firmware = PX4,
    boot_s: float = 0.0,
) -> Iterator[Autopilot]:
    """Run an autopilot at a file descriptor during the body."""
    stop = threading.Event()
    autopilot = Autopilot(
        firmware=firmware,
        system=SYSTEM,
        limits=LIMITS,
        airframe_limits=DUCKIEDRONE,
        obstacles=Ground(None, None).obstacles,
        now_ns=time.monotonic_ns(),
        boot_s=boot_s,
    )

    def fly() -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(descriptor, selectors.EVENT_READ)
            while not stop.is_set():
                with suppress(OSError):  # there is no peer yet, or it has closed
                    received = receive(65_536) if selector.select(0.02) else b""
                    replies = list(autopilot.receive(received, PEER, time.monotonic_ns()))
                    for _, frame in (*replies, *autopilot.advance(time.monotonic_ns())):
                        send(frame)

    thread = threading.Thread(target=fly)
    thread.start()
    try:
        yield autopilot
    finally:
        stop.set()
        thread.join()


@contextmanager
def at_udp(damage: Damage = lambda frame: [frame], firmware: Firmware = PX4) -> Iterator[int]:
    """Run a drone at a UDP port on loopback; `damage` changes its frames."""
    with autopilot_at_udp(damage, firmware) as (port, _):
        yield port


@contextmanager
def autopilot_at_udp(
    damage: Damage = lambda frame: [frame], firmware: Firmware = PX4, boot_s: float = 0.0
) -> Iterator[tuple[int, Autopilot]]:
    """As `at_udp`, but also yield the autopilot; all clients receive all frames, as from a router."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
        endpoint.bind(("127.0.0.1", 0))
        peers: list[tuple[str, int]] = []

        def receive(size: int) -> bytes:
            data, sender = endpoint.recvfrom(size)
            if sender not in peers:
                peers.append(sender)
            return data

        def send(frame: bytes) -> None:
            for datagram in damage(frame):
                for peer in peers:
                    endpoint.sendto(datagram, peer)

        with flying(endpoint.fileno(), send, receive, firmware, boot_s) as autopilot:
            yield endpoint.getsockname()[1], autopilot


@contextmanager
def at_terminal(damage: Damage = lambda frame: [frame]) -> Iterator[str]:
    """Run a drone at a serial line; its output starts in the middle of a frame.

    The path is a symbolic link, removed at the end. A link server that still runs would otherwise open the
    pseudo-terminal of a later test, which has the same number.
    """
    master, terminal = os.openpty()

    def send(frame: bytes) -> None:
        os.write(master, b"".join(damage(frame)))

    try:
        os.set_blocking(master, True)
        os.write(master, Sender().frame(beat())[3:])
        with TemporaryDirectory() as folder, flying(master, send, lambda size: os.read(master, size)):
            device = Path(folder) / "ttyACM0"
            device.symlink_to(os.ttyname(terminal))
            yield str(device)
    finally:
        os.close(master)
        os.close(terminal)


class UsbSerial:
    """A serial line at a USB port; its device disappears when it is unplugged, and appears again when it is plugged
    in.

    Args:
        path: Path of the device.
        drone: Socket to the autopilot at the other end.
    """

    def __init__(self, path: Path, drone: socket.socket) -> None:
        self.path = path
        self._drone = drone
        self._master, self._terminal = -1, -1
        self._changing = threading.Lock()

    def plug_in(self) -> None:
        """Create the device."""
        with self._changing:
            self._master, self._terminal = os.openpty()
            os.set_blocking(self._master, False)
            self.path.symlink_to(os.ttyname(self._terminal))

    def pull_out(self) -> None:
        """Remove the device: a program that has opened it gets an error."""
        with self._changing:
            if self._master >= 0:
                self.path.unlink()
                os.close(self._terminal)
                os.close(self._master)
            self._master = self._terminal = -1

    def forward(self) -> None:
        """Forward received data in both directions; without a device, the data is lost."""
        drone = self._drone.fileno()
        ready, _, _ = select.select([drone, *([self._master] if self._master >= 0 else [])], [], [], 0.01)
        with self._changing, suppress(OSError):  # the line is full, closed or unplugged
            if drone in ready:
                data = self._drone.recv(65_536)
                if self._master >= 0:
                    os.write(self._master, data)
            if self._master >= 0 and self._master in ready:
                self._drone.sendall(os.read(self._master, 65_536))


@contextmanager
def autopilot_at_usb(path: Path, firmware: Firmware = ARDUCOPTER) -> Iterator[tuple[UsbSerial, Autopilot]]:
    """Run a drone at a serial device that can be unplugged."""
    usb_end, drone_end = socket.socketpair()
    usb, stop = UsbSerial(path, usb_end), threading.Event()

    def forward() -> None:
        while not stop.is_set():
            with suppress(OSError):  # the line was unplugged during `select`
                usb.forward()

    thread = threading.Thread(target=forward)
    with usb_end, drone_end, flying(drone_end.fileno(), drone_end.sendall, drone_end.recv, firmware) as autopilot:
        usb.plug_in()
        thread.start()
        try:
            yield usb, autopilot
        finally:
            stop.set()
            thread.join()
            usb.pull_out()


def damage_randomly(seed: int) -> Damage:
    """A function that adds damaged frames and random bytes to each frame."""
    random_source = random.Random(seed)

    def damaged(frame: bytes) -> Iterator[bytes]:
        yield frame
        flipped = bytearray(frame)
        for _ in range(random_source.choice((1, 1, 4, 16))):
            flipped[random_source.randrange(len(flipped))] = random_source.randrange(256)
        yield bytes(flipped)
        yield frame[: random_source.randrange(len(frame))]
        yield random_source.randbytes(random_source.choice((0, 1, 2, 3, 8, 300)))
        yield bytes((0xFD, 255, random_source.randrange(256))) + random_source.randbytes(random_source.randrange(40))

    return damaged
