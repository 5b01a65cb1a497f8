"""The lab's handle on the medium process."""

import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import IO, Final, Self

import sim_backends
from fieldkit.deadline import Deadline
from fieldkit.errors import ConfigurationError, LinkError
from fieldkit.profiles import Radio
from sim_backends.emulated import medium_wire
from sim_backends.emulated.medium_wire import MediumStats, Message
from sim_backends.radio.links import Position, mesh, stations_of
from sim_backends.radio.options import RadioOptions
from sim_backends.radio.parameters import LinkParameters, Pair

_REPLY_S: Final = 15.0
_END_S: Final = 2.0


class MediumClient:
    """Starts the medium, gives it the robots' TUN devices and tells it where they stand; use as a context manager.

    The medium ends with this object, and with this process however that ends: its control socket closes, and the
    kernel kills it with the thread that called `spawn`. So call `spawn` from a thread that lives as long as the lab.
    Not safe for use from several threads at once.
    """

    def __init__(
        self, options: RadioOptions, channel: socket.socket, process: subprocess.Popen[bytes], log: IO[bytes]
    ) -> None:
        self._options = options
        self._channel = channel
        self._process = process
        self._log = log
        self._radios: dict[str, Radio] = {}

    @classmethod
    def spawn(cls, options: RadioOptions, *, seed: int) -> Self:
        """Start the medium; returns at once, the first request waits until it is up.

        Args:
            options: The radio.
            seed: Seed of everything random in it.

        Raises:
            ConfigurationError: `setpriv` is missing.
        """
        ours, theirs = socket.socketpair()
        log = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as the process; `close` closes it)
        argv = ["setpriv", "--pdeathsig", "KILL", "--", sys.executable]
        argv += ["-m", "sim_backends.emulated.medium", str(theirs.fileno()), str(seed)]
        try:
            process = subprocess.Popen(
                argv,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                # Ctrl-C in a terminal reaches the whole group; the lab decides when the medium ends.
                start_new_session=True,
                # Where `-m` finds this package even when it is not installed.
                cwd=Path(sim_backends.__file__).resolve().parents[1],
            )
        except OSError as error:
            ours.close()
            log.close()
            raise ConfigurationError(
                f"cannot start the medium: {error}", remedy="install setpriv: apt-get install util-linux"
            ) from error
        finally:
            theirs.close()
        return cls(options, ours, process, log)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id of the medium."""
        return self._process.pid

    def attach(self, name: str, address: str, radio: Radio, tun_fd: int) -> None:
        """Connect a robot.

        Args:
            name: The robot's name.
            address: Its IPv4 address on the radio with the length of the network, `10.42.0.1/24`.
            radio: Its radio.
            tun_fd: Descriptor of its TUN device; the medium gets a copy, the caller closes this one.

        Raises:
            LinkError: The medium ended or did not answer, or has that name or address already.
        """
        self._ask({"do": "attach", "name": name, "address": address}, [tun_fd])
        self._radios[name] = radio

    def place(
        self, positions_m: Mapping[str, Position], *, behind_wall: Set[str] = frozenset(), relay: str | None = None
    ) -> dict[Pair, LinkParameters]:
        """Put the robots in their places; packets from now on meet the links that follow.

        Args:
            positions_m: Where each robot stands, metres east, north, up. Robots not named are out of the game.
            behind_wall: The robots behind the wall.
            relay: The robot whose access point relays between the others; None for direct links.

        Returns:
            What is applied to each directed link.

        Raises:
            ConfigurationError: A robot is named that is not attached, or a relay that has no place.
            LinkError: The medium ended or did not answer.
        """
        cast = {*behind_wall, relay} if relay is not None else set(behind_wall)
        unknown = (positions_m.keys() - self._radios.keys()) | (cast - positions_m.keys())
        if unknown:
            raise ConfigurationError(
                f"robots without a radio or a place: {', '.join(sorted(unknown))}",
                remedy="attach every robot, and give each one behind the wall and the relay a position",
            )
        links = mesh(self._options, stations_of(self._radios, positions_m, behind_wall))
        self._ask({"do": "connect", "links": medium_wire.pack_links(links), "relay": relay})
        return links

    def stats(self) -> MediumStats:
        """Return what the medium did so far.

        Raises:
            LinkError: The medium ended or did not answer.
        """
        return medium_wire.unpack_stats(self._ask({"do": "stats"}))

    def close(self) -> None:
        """End the medium and wait until it is gone; does nothing the second time."""
        self._channel.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._log.close()

    def _ask(self, request: Message, descriptors: Sequence[int] = ()) -> Message:
        deadline = Deadline.after(_REPLY_S)
        try:
            medium_wire.send(self._channel, request, deadline, descriptors)
            received = medium_wire.receive(self._channel, deadline)
        except (OSError, ValueError) as error:
            # A late reply would be taken for the next one's.
            self._channel.close()
            raise self._gone(str(error)) from error
        if received is None:
            raise self._gone("it closed the connection")
        reply, _ = received
        if "error" in reply:
            raise LinkError(f"the medium refused a request: {reply['error']}", where=f"medium, pid {self.pid}")
        return reply

    def _gone(self, cause: str) -> LinkError:
        log = os.pread(self._log.fileno(), 1 << 16, 0).decode(errors="replace").strip()
        last_line = log.rsplit("\n", 1)[-1]
        return LinkError(
            f"the medium does not answer: {cause}" + (f"; it said: {last_line}" if last_line else ""),
            where=f"medium, pid {self.pid}",
            remedy="start the lab again",
        )
