"""A drone that a test talks with over a socket or a terminal, and telemetry logs made message by message."""

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
from typing import Any, Final

from pymavlink.dialects.v20 import common as d

from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from sim_backends.emulated.autopilot.autopilot import Autopilot
from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.px4 import PX4
from sim_backends.physics.ground import Ground
from sim_backends.physics.quadrotor import DUCKIEDRONE
from tests.helpers.ground_station import LIMITS

SYSTEM: Final = 7
PEER: Final = ("gcs", 1)
"""Who the drone takes everybody for."""
START_US: Final = 1_795_000_000_000_000
"""In November 2026."""

Damage = Callable[[bytes], Iterable[bytes]]
"""Makes of a frame what is sent in its place."""


class Sender:
    """Makes frames of messages, as one component does.

    Args:
        system: Its system.
        component: Its component.
    """

    def __init__(self, system: int = SYSTEM, component: int = 1) -> None:
        self.link = d.MAVLink(None, srcSystem=system, srcComponent=component)

    def frame(self, message: Any) -> bytes:  # noqa: ANN401 (of pymavlink)
        packed: bytes = message.pack(self.link)
        self.link.seq = (self.link.seq + 1) % 256
        return packed


def stamped(frames: Iterable[tuple[int, bytes]]) -> bytes:
    """Return a telemetry log of frames, each with its time in us after `START_US`."""
    return b"".join(struct.pack(">Q", START_US + at_us) + frame for at_us, frame in frames)


def beat(*, armed: bool = False) -> Any:  # noqa: ANN401
    mode = d.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
    return d.MAVLink_heartbeat_message(d.MAV_TYPE_QUADROTOR, d.MAV_AUTOPILOT_PX4, mode, 0, d.MAV_STATE_ACTIVE, 3)


def flight(seconds: float = 10.0, speed_m_s: float = 1.0, lost: Callable[[int], bool] = lambda _: False) -> bytes:
    """Return the log of a drone that flies north at a height of 3 m, and looks there, 10 messages a second."""
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
    """Let an autopilot answer at a descriptor while the body runs."""
    over = threading.Event()
    autopilot = Autopilot(
        firmware=firmware,
        system=SYSTEM,
        limits=LIMITS,
        airframe_limits=DUCKIEDRONE,
        obstacles=Ground(None, None).around,
        now_ns=time.monotonic_ns(),
        boot_s=boot_s,
    )

    def fly() -> None:
        with selectors.DefaultSelector() as waiting:
            waiting.register(descriptor, selectors.EVENT_READ)
            while not over.is_set():
                with suppress(OSError):  # nobody is there any more, or yet
                    came = receive(65_536) if waiting.select(0.02) else b""
                    answers = list(autopilot.receive(came, PEER, time.monotonic_ns()))
                    for _, frame in (*answers, *autopilot.advance(time.monotonic_ns())):
                        send(frame)

    thread = threading.Thread(target=fly)
    thread.start()
    try:
        yield autopilot
    finally:
        over.set()
        thread.join()


@contextmanager
def at_udp(damage: Damage = lambda frame: [frame], firmware: Firmware = PX4) -> Iterator[int]:
    """Let a drone listen at a port of UDP on loopback, and what it sends be damaged."""
    with autopilot_at_udp(damage, firmware) as (port, _):
        yield port


@contextmanager
def autopilot_at_udp(
    damage: Damage = lambda frame: [frame], firmware: Firmware = PX4, boot_s: float = 0.0
) -> Iterator[tuple[int, Autopilot]]:
    """Do the same, and let the test see the autopilot itself; all clients get all frames, as from a router."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
        endpoint.bind(("127.0.0.1", 0))
        peers: list[tuple[str, int]] = []

        def receive(most: int) -> bytes:
            data, sender = endpoint.recvfrom(most)
            if sender not in peers:
                peers.append(sender)
            return data

        def send(frame: bytes) -> None:
            for one in damage(frame):
                for peer in peers:
                    endpoint.sendto(one, peer)

        with flying(endpoint.fileno(), send, receive, firmware, boot_s) as autopilot:
            yield endpoint.getsockname()[1], autopilot


@contextmanager
def at_terminal(damage: Damage = lambda frame: [frame]) -> Iterator[str]:
    """Let a drone be at a serial line, which goes on in the midst of a frame."""
    ours, theirs = os.openpty()

    def send(frame: bytes) -> None:
        os.write(ours, b"".join(damage(frame)))

    try:
        os.set_blocking(ours, True)
        os.write(ours, Sender().frame(beat())[3:])
        with flying(ours, send, lambda most: os.read(ours, most)):
            yield os.ttyname(theirs)
    finally:
        os.close(ours)
        os.close(theirs)


class UsbSerial:
    """A serial line at a USB port: its device disappears when it is pulled out, and comes back.

    Args:
        path: Of the device.
        drone: Socket to the autopilot at its other end.
    """

    def __init__(self, path: Path, drone: socket.socket) -> None:
        self.path = path
        self._drone = drone
        self._ours, self._theirs = -1, -1
        self._changing = threading.Lock()

    def plug_in(self) -> None:
        """Let the device appear."""
        with self._changing:
            self._ours, self._theirs = os.openpty()
            os.set_blocking(self._ours, False)
            self.path.symlink_to(os.ttyname(self._theirs))

    def pull_out(self) -> None:
        """Let the device disappear: a program that has opened it gets an error."""
        with self._changing:
            if self._ours >= 0:
                self.path.unlink()
                os.close(self._theirs)
                os.close(self._ours)
            self._ours = self._theirs = -1

    def forward(self) -> None:
        """Forward what has arrived, in both directions; without a device it is lost."""
        drone = self._drone.fileno()
        ready, _, _ = select.select([drone, *([self._ours] if self._ours >= 0 else [])], [], [], 0.01)
        with self._changing, suppress(OSError):  # full, closed, or pulled out meanwhile
            if drone in ready:
                data = self._drone.recv(65_536)
                if self._ours >= 0:
                    os.write(self._ours, data)
            if self._ours >= 0 and self._ours in ready:
                self._drone.sendall(os.read(self._ours, 65_536))


@contextmanager
def autopilot_at_usb(path: Path, firmware: Firmware = ARDUCOPTER) -> Iterator[tuple[UsbSerial, Autopilot]]:
    """Let a drone be at a serial device that can be pulled out."""
    near, far = socket.socketpair()
    usb, over = UsbSerial(path, near), threading.Event()

    def forward() -> None:
        while not over.is_set():
            with suppress(OSError):  # pulled out while it waited
                usb.forward()

    thread = threading.Thread(target=forward)
    with near, far, flying(far.fileno(), far.sendall, far.recv, firmware) as autopilot:
        usb.plug_in()
        thread.start()
        try:
            yield usb, autopilot
        finally:
            over.set()
            thread.join()
            usb.pull_out()


def hostile(seed: int) -> Damage:
    """Return what sends with each frame damaged ones, and bytes that are none."""
    dice = random.Random(seed)

    def damaged(frame: bytes) -> Iterator[bytes]:
        yield frame
        flipped = bytearray(frame)
        for _ in range(dice.choice((1, 1, 4, 16))):
            flipped[dice.randrange(len(flipped))] = dice.randrange(256)
        yield bytes(flipped)
        yield frame[: dice.randrange(len(frame))]
        yield dice.randbytes(dice.choice((0, 1, 2, 3, 8, 300)))
        yield bytes((0xFD, 255, dice.randrange(256))) + dice.randbytes(dice.randrange(40))

    return damaged
