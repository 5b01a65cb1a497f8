"""The lab's client of the medium of mac80211_hwsim: it has the socket that is registered with the kernel."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from types import MappingProxyType
from typing import Any

from typing_extensions import override

from fieldkit.config.profiles import Radio
from fieldkit.core.model import Vector
from sim_backends.emulated.linux_wifi.access_points import AccessPoints
from sim_backends.emulated.linux_wifi.hwsim_socket import open_registered
from sim_backends.emulated.linux_wifi.radios import HwsimRadio
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.emulated.process.worker import Worker
from sim_backends.emulated.robot.spec import WifiSpec
from sim_backends.radio.antennas import antenna_of
from sim_backends.radio.infrastructure.infrastructure import station_place_m
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import Attitude
from sim_backends.world.world import World


class WifiClient(MediumClient):
    """Starts the medium of the simulated radios (hwsim), and access points that are not robots.

    Arguments that are not described are those of `MediumClient`. This object keeps the registered socket open. If the
    medium is killed or suspended, no frame is delivered. After `place`, `robot_names` also has the names of the
    access points.

    Args:
        radios: Radio of each robot and access point, by its name.
        station: Wi-Fi settings of the robots that are stations of these access points.

    Raises:
        ConfigurationError: The kernel has no mac80211_hwsim, or a program of util-linux is missing.
        RobotError: An access point did not start.
    """

    module = "sim_backends.emulated.linux_wifi.medium_program"

    def __init__(
        self,
        options: RadioOptions,
        world: World | None = None,
        *,
        seed: int,
        radios: Mapping[str, HwsimRadio],
        station: WifiSpec,
    ) -> None:
        self._kernel = open_registered()
        self._seed = seed
        self._radios = dict(radios)
        self._setups: dict[str, dict[str, Any]] = {}
        self._access_points_m = {
            name: station_place_m(access_point.at_m, access_point.height, world)
            for name, access_point in options.access_points.items()
        }
        self._access_points: AccessPoints | None = None
        super().__init__(options, world, seed=seed)
        if options.access_points:
            try:
                self._access_points = AccessPoints({name: radios[name] for name in options.access_points}, station)
            except BaseException:
                self.close()
                raise

    @override
    def _start(self) -> Worker:
        descriptor = self._kernel.fileno()
        return Worker("medium", self.module, words=("--fd", str(descriptor)), descriptors=(descriptor,))

    @override
    def attach(
        self, name: str, address: str, radio: Radio, fd: int | None, *, physics_fds: Sequence[int] = ()
    ) -> None:
        antenna = antenna_of(radio)
        self._setups[name] = {
            "address": self._radios[name].address,
            "standard": antenna.standard,
            "tx_power_dbm": antenna.tx_power_dbm,
            "sensitivity_dbm": antenna.sensitivity_dbm,
        }
        if antenna.pattern is not None:
            self._has_patterns = True
            self._setups[name]["pattern"] = asdict(antenna.pattern)
        self._robots.add(name)

    @override
    def place(
        self,
        positions_m: Mapping[str, Vector],
        *,
        relay: str | None = None,
        velocities_m_s: Mapping[str, Vector] = MappingProxyType({}),
        attitudes: Mapping[str, Attitude] = MappingProxyType({}),
    ) -> None:
        """Implement `MediumClient.place`; access points that are not robots keep their positions in the site file."""
        self._robots |= self._access_points_m.keys()
        positions_m = {**self._access_points_m, **positions_m}
        super().place(positions_m, relay=relay, velocities_m_s=velocities_m_s, attitudes=attitudes)

    @override
    def _configure(self) -> None:
        # Access points have the radio of the first robot, except for the transmit power and the antenna.
        robot_setup = {**next(iter(self._setups.values())), "pattern": None}
        for name, access_point in self._options.access_points.items():
            power_dbm = float(access_point.tx_power_dbm)
            self._setups[name] = {**robot_setup, "address": self._radios[name].address, "tx_power_dbm": power_dbm}
        world = None if self._world is None else self._world.model_dump(mode="json")
        options = self._options.model_dump(mode="json")
        self._worker.request({"seed": self._seed, "radios": self._setups, "options": options, "world": world})

    @override
    def check_alive(self) -> None:
        super().check_alive()
        if self._access_points is not None:
            self._access_points.check_alive()

    @override
    def close(self) -> None:
        if self._access_points is not None:
            self._access_points.close()
        super().close()
        self._kernel.close()
