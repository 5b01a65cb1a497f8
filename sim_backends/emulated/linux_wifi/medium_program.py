"""Program that runs the medium of mac80211_hwsim as a process.

The command is `python -m sim_backends.emulated.linux_wifi.medium_program [CHANNEL] [--fd FD]`; it needs root.

It registers as the medium of all radios of mac80211_hwsim that were created in its network namespace. It reads
requests from the socket with the descriptor CHANNEL, or from standard input, and writes the replies to that socket or
to standard output. Requests and replies are JSON objects, one per line. The first request is `MediumSetup`. Later
requests are

    {"do": "place", "positions": {"r1": [0, 0, 1]}, "velocities": {}}
    {"do": "totals"}

Positions in metres and velocities in metres per second are east, north, up. A radio without a position is out of
range. The request `place` may also have `attitudes`: the yaw, pitch and roll of radios in radians, by name
(`Attitude`). The reply to an invalid request is `{"error": TEXT}`.

It exits when the requests end. When the last descriptor of the registered socket is closed, hwsim again delivers all
frames without loss. A supervisor therefore opens the socket with `hwsim_socket.open_registered`, keeps it open, and
passes its descriptor with `--fd`. If the medium is then killed, no frame is delivered until a new medium is started
with this descriptor.
"""

import argparse
import json
import os
import select
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from typing import Annotated, Any, Final, Protocol

from fieldkit.config.schema import AfterValidator, Int, Number, Strict, validation_error
from fieldkit.core.errors import ConfigurationError
from sim_backends.emulated.linux_wifi.air import Air
from sim_backends.emulated.linux_wifi.hwsim_medium import HwsimMedium
from sim_backends.emulated.linux_wifi.hwsim_messages import RadioAddress
from sim_backends.emulated.linux_wifi.hwsim_socket import open_registered
from sim_backends.emulated.linux_wifi.netlink import NetlinkFormatError, NetlinkMessage
from sim_backends.emulated.medium.timerfd import Timer
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.phy.modes import Standard
from sim_backends.radio.propagation.antenna_patterns import decode_pattern
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import Attitude
from sim_backends.world.world import World

_BURST: Final = 64
"""Maximum number of datagrams of the kernel that are received before requests are served."""
_MAX_REQUEST_BYTES: Final = 1 << 20
_READ_BYTES: Final = 1 << 16


def _radio_address(text: str) -> str:
    try:
        is_valid = len(bytes.fromhex(text.replace(":", ""))) == 6
    except ValueError:
        is_valid = False
    if not is_valid:
        raise validation_error(f"{text!r} is not an address like 42:00:00:00:01:00")
    return text


class RadioSetup(Strict):
    """A radio of hwsim.

    Attributes:
        address: Its address, `42:00:00:00:NN:00` for radio NN.
        standard: Its IEEE 802.11 amendment.
        tx_power_dbm: Transmit power.
        sensitivity_dbm: Received power of the weakest frame that it detects.
        pattern: Pattern of its antenna, as `dataclasses.asdict` returns it; None if it is isotropic.
    """

    address: Annotated[str, AfterValidator(_radio_address)]
    standard: Standard = "802.11n"
    tx_power_dbm: Number | Int = 15
    sensitivity_dbm: Number | Int = -92
    pattern: dict[str, Any] | None = None


class MediumSetup(Strict):
    """The first request.

    Attributes:
        seed: Seed of all random draws.
        radios: The radios, by name.
        options: Radio options of the site file.
        world: World of the lab; None for open ground.
    """

    seed: Int
    radios: dict[str, RadioSetup]
    options: RadioOptions = RadioOptions()
    world: World | None = None

    def medium(self) -> HwsimMedium:
        """Return the medium of this setup."""
        antennas = {
            name: Antenna(
                radio.standard,
                float(radio.tx_power_dbm),
                float(radio.sensitivity_dbm),
                pattern=None if radio.pattern is None else decode_pattern(radio.pattern),
            )
            for name, radio in self.radios.items()
        }
        addresses = {
            RadioAddress(bytes.fromhex(radio.address.replace(":", ""))): name for name, radio in self.radios.items()
        }
        return HwsimMedium(Air(self.seed, self.options, antennas, self.world), addresses)


class KernelSocket(Protocol):
    """The interface of a netlink socket that the medium uses; `FamilySocket` implements it.

    Attributes:
        overruns: Number of times that the kernel reported dropped messages, because the socket was full.
    """

    overruns: int

    def fileno(self) -> int:
        """Return its descriptor."""
        ...

    def send(self, payload: bytes) -> None:
        """Send a message."""
        ...

    def receive(self) -> list[NetlinkMessage]:
        """Return messages; an empty list if there is none.

        Raises:
            NetlinkFormatError: A message is malformed.
        """
        ...


class RequestLines:
    """Reads lines from a descriptor.

    Args:
        fd: The descriptor.

    Attributes:
        fd: The descriptor.
        is_at_end: True after the end of the data was read.
    """

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self.is_at_end = False
        self._buffer = b""

    def read(self) -> Iterator[bytes]:
        """Wait for data, read once, and yield the complete lines; an incomplete line is kept for the next call.

        Raises:
            ValueError: A line is too long.
        """
        data = os.read(self.fd, _READ_BYTES)
        self.is_at_end = not data
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        if len(self._buffer) > _MAX_REQUEST_BYTES:
            raise ValueError(f"a request is longer than {_MAX_REQUEST_BYTES} bytes")
        yield from lines


def serve(kernel: KernelSocket, requests: RequestLines, reply_fd: int) -> None:
    """Carry frames and answer requests until there are no more requests."""
    medium: HwsimMedium | None = None
    timer = Timer()
    epoll = select.epoll()
    try:
        epoll.register(timer.fd, select.EPOLLIN | select.EPOLLET)
        epoll.register(kernel.fileno(), select.EPOLLIN)
        epoll.register(requests.fd, select.EPOLLIN)
        while not requests.is_at_end:
            next_ns = None if medium is None else medium.air.next_event_ns()
            if next_ns is not None:
                timer.set(next_ns)
            ready = {fd for fd, _ in epoll.poll()}
            now_ns = time.monotonic_ns()
            if kernel.fileno() in ready:
                _receive(kernel, medium, now_ns)
            if medium is not None:
                for message in medium.replies(now_ns):
                    kernel.send(message)
            if requests.fd in ready:
                for line in requests.read():
                    medium, reply = _answer(medium, kernel, line)
                    os.write(reply_fd, json.dumps(reply).encode() + b"\n")
    finally:
        epoll.close()
        timer.close()


def _receive(kernel: KernelSocket, medium: HwsimMedium | None, now_ns: int) -> None:
    """Receive a burst of messages; without a medium they are discarded."""
    for _ in range(_BURST):
        try:
            messages = kernel.receive()
        except NetlinkFormatError:
            if medium is not None:
                medium.counts.rejected_messages += 1
            continue
        if not messages:
            return
        for message in messages:
            if medium is not None:
                medium.receive(now_ns, message)


def _answer(
    medium: HwsimMedium | None, kernel: KernelSocket, line: bytes
) -> tuple[HwsimMedium | None, dict[str, Any]]:
    """Return the medium after a request (None before a valid first request), and the reply.

    An invalid request changes nothing.
    """
    try:
        request = json.loads(line)
        if medium is None:
            return MediumSetup.model_validate(request).medium(), {}
        match request["do"]:
            case "place":
                positions_m = {str(name): _vector(position_m) for name, position_m in request["positions"].items()}
                velocities_m_s = {str(name): _vector(value) for name, value in request["velocities"].items()}
                attitudes = {name: Attitude(*_vector(rad)) for name, rad in request.get("attitudes", {}).items()}
                medium.air.place(time.monotonic_ns(), positions_m, velocities_m_s, attitudes)
                return medium, {}
            case "totals":
                links = [
                    {"transmitter": transmitter, "receiver": receiver, **asdict(totals)}
                    for (transmitter, receiver), totals in medium.totals.items()
                ]
                errors = {os.strerror(number): count for number, count in medium.counts.errors.items()}
                counts = {"rejected": medium.counts.rejected_messages, "overruns": kernel.overruns, "errors": errors}
                return medium, {"links": links, **counts}
            case other:
                return medium, {"error": f"unknown request {other!r}"}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        return medium, {"error": f"{type(error).__name__}: {error}"}


def _vector(values: Any) -> tuple[float, float, float]:  # noqa: ANN401 (JSON)
    east_m, north_m, up_m = values
    return float(east_m), float(north_m), float(up_m)


def main() -> int:
    """Run the medium until the requests end."""
    parser = argparse.ArgumentParser(description="The medium of all radios of mac80211_hwsim.")
    parser.add_argument("channel", type=int, nargs="?", help="descriptor of a socket with requests")
    parser.add_argument("--fd", type=int, help="descriptor of a socket that is registered as the medium")
    options = parser.parse_args()
    try:
        kernel = open_registered(options.fd)
    except ConfigurationError as error:
        sys.stderr.write(f"error: {error.what}\n  remedy: {error.remedy}\n")
        return 2
    try:
        channel = options.channel
        requests, replies = (sys.stdin.fileno(), sys.stdout.fileno()) if channel is None else (channel, channel)
        serve(kernel, RequestLines(requests), replies)
    finally:
        kernel.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
