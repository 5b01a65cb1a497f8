"""The lab's client of the medium, which starts the process of the medium and sends requests to it."""

from collections.abc import Mapping, Sequence, Set
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Self

from fieldkit.config.profiles import Radio
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import DelayParts, LinkSample, Vector
from sim_backends.emulated.medium import air_files
from sim_backends.emulated.medium.framing import IP, Framing
from sim_backends.emulated.medium.medium_stats import MediumStats, unpack_links, unpack_stats
from sim_backends.emulated.process.worker import Worker
from sim_backends.radio.antennas import antenna_of
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import Attitude
from sim_backends.world.world import World


class MediumClient:
    """Starts the medium and sends it the robots' TUN or TAP devices and positions; use as a context manager.

    The process starts when the object is created, and the first request waits until the process is ready. The kernel
    kills the process when the thread that created the object ends, so create it in a thread that exists as long as
    the lab.

    Args:
        options: Options of the radio.
        world: The world with the obstacles between the robots; None for open ground.
        seed: Seed of all random numbers of the medium.
        framing: Framing of the devices.

    Raises:
        ConfigurationError: A program of util-linux is missing.
    """

    module = "sim_backends.emulated.medium.process"
    """Module of the process."""

    def __init__(
        self, options: RadioOptions, world: World | None = None, *, seed: int, framing: Framing = IP
    ) -> None:
        self._options = options
        self._world = world
        self._is_configured = False
        self._has_patterns = False
        self._words = str(seed), framing.name
        self._worker = self._start()
        self._robots: set[str] = set()

    def _start(self) -> Worker:
        return Worker("medium", self.module, words=self._words)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id of the medium."""
        return self._worker.pid

    @property
    def robot_names(self) -> Set[str]:
        """Names of the attached robots; with Linux Wi-Fi also those of the access points, after `place`."""
        return self._robots

    def attach(
        self,
        name: str,
        address: str,
        radio: Radio,
        fd: int | None,
        *,
        physics_fds: Sequence[int] = (),  # noqa: ARG002 (see below)
    ) -> None:
        """Attach a robot to the medium.

        Args:
            name: The robot's name.
            address: Its IPv4 address on the radio with the prefix length, `10.42.0.1/24`.
            radio: Its radio.
            fd: Descriptor of its device, or of a packet socket: each read returns one framed packet, and each write
                accepts one. The medium gets a copy; the caller closes this descriptor. None for a radio of the
                kernel, which has no device.
            physics_fds: `EmulatedRobot.physics_fds`, for a medium with a physics simulator; other media ignore them.

        Raises:
            LinkError: The medium process exited or did not answer.
            RobotError: A robot with this name or address is already attached.
        """
        antenna = antenna_of(radio)
        self._has_patterns |= antenna.pattern is not None
        self._worker.request(
            {"do": "attach", "name": name, "address": address, "antenna": asdict(antenna)},
            descriptors=[] if fd is None else [fd],
        )
        self._robots.add(name)

    def place(
        self,
        positions_m: Mapping[str, Vector],
        *,
        relay: str | None = None,
        velocities_m_s: Mapping[str, Vector] = MappingProxyType({}),
        attitudes: Mapping[str, Attitude] = MappingProxyType({}),
    ) -> None:
        """Place the robots; later packets cross the obstacles between these positions.

        Positions are valid until the next call. A velocity does not move a robot; it only sets the speed of the
        fading.

        Args:
            positions_m: Position of each antenna, metres east, north, up. Robots that are not named are off the air.
            relay: The robot whose access point relays between the others; None if they communicate directly.
            velocities_m_s: Velocities, metres per second east, north, up; 0 for robots that are not named.
            attitudes: Attitudes of robots, which matter if an antenna has a pattern; the others keep theirs.

        Raises:
            ConfigurationError: A named robot is not attached, or the relay has no position.
            LinkError: The medium process exited or did not answer.
        """
        # Positions of unknown robots, and a relay without a position.
        invalid_names = (positions_m.keys() - self._robots) | ({relay} - {None} - positions_m.keys())
        if invalid_names:
            raise ConfigurationError(
                f"robots without a radio or a position: {', '.join(sorted(map(str, invalid_names)))}",
                remedy="attach every robot, and give the relay a position",
            )
        if not self._is_configured:
            self._configure()
            self._is_configured = True
        message = {"do": "place", "positions": positions_m, "relay": relay, "velocities": dict(velocities_m_s)}
        if self._has_patterns:
            message["attitudes"] = dict(attitudes)
        self._worker.request(message)

    def _configure(self) -> None:
        world = None if self._world is None else self._world.model_dump(mode="json")
        self._worker.request({"do": "use", "options": self._options.model_dump(mode="json"), "world": world})

    def record(self, folder: Path | None) -> None:
        """Record later transmissions in files in `folder` (`air_log`), or stop recording if it is None.

        Raises:
            LinkError: The medium process exited or did not answer.
            OSError: The files cannot be created.
        """
        with ExitStack() as stack:
            paths = () if folder is None else (folder / air_files.PCAP, folder / air_files.CSV)
            files = [stack.enter_context(path.open("wb")) for path in paths]
            self._worker.request({"do": "record"}, descriptors=[file.fileno() for file in files])

    def stats(self) -> MediumStats:
        """Return the statistics of the medium.

        Raises:
            LinkError: The medium process exited or did not answer.
        """
        reply, _ = self._worker.request({"do": "stats"})
        return unpack_stats(reply)

    def delays(self, source: str, destination: str, protocol: int, port: int) -> DelayParts:
        """Return the delays of the delivered packets of one flow, summed since the first call for this flow.

        Args:
            source: The robot that sends.
            destination: The robot that receives.
            protocol: IP protocol number, of TCP or UDP.
            port: Port of `destination`.

        Raises:
            LinkError: The medium process exited or did not answer.
            RobotError: No robot with this name is attached.
        """
        request = {"do": "delays", "source": source, "destination": destination, "protocol": protocol, "port": port}
        reply, _ = self._worker.request(request)
        return DelayParts(**reply)

    def links(self, *, continue_sampling: bool) -> dict[str, list[LinkSample]]:
        """Return the link samples of each robot since the last call, including one taken now.

        Args:
            continue_sampling: True to continue sampling.

        Raises:
            LinkError: The medium process exited or did not answer.
        """
        reply, _ = self._worker.request({"do": "links", "continue_sampling": continue_sampling})
        return unpack_links(reply)

    def check_alive(self) -> None:
        """Raise the errors of `Worker.check_alive` if the medium does not run."""
        self._worker.check_alive()

    def close(self) -> None:
        """Stop the medium and wait until it has exited; a second call does nothing."""
        self._worker.close()
