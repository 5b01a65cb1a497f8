"""Wi-Fi of Linux in an emulated lab: the part of each robot in the network, its radio, and their medium."""

import secrets
from collections.abc import Iterable, Mapping
from typing import TypeVar

from fieldkit.backends.protocols import Robot
from fieldkit.core.model import Role
from fieldkit.lab.robots import LabRobot
from sim_backends.emulated.linux_wifi.radios import HwsimRadio, require_radios
from sim_backends.emulated.linux_wifi.wifi_client import WifiClient
from sim_backends.emulated.robot.spec import WifiSpec
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import World

Key = TypeVar("Key")

_PASSPHRASE_BYTES = 12


def parts(robots: Mapping[Key, Robot | LabRobot]) -> dict[Key, WifiSpec]:
    """Return the part of each robot: the relay of a trial runs the access point; without a relay, all are ad hoc."""
    if Role.RELAY not in robots:
        return dict.fromkeys(robots, WifiSpec("ad hoc"))
    passphrase = secrets.token_hex(_PASSPHRASE_BYTES)
    return {key: WifiSpec("access point" if key == Role.RELAY else "station", passphrase) for key in robots}


def radios_of(robots: Iterable[Robot | LabRobot]) -> dict[str, HwsimRadio]:
    """Return the radio of each robot by its name; errors as `require_radios`."""
    names = [robot.name for robot in robots]
    return dict(zip(names, require_radios(len(names)), strict=True))


def medium(options: RadioOptions, world: World, seed: int, radios: Mapping[str, HwsimRadio]) -> WifiClient:
    """Return the medium of the robots' radios; errors as `WifiClient`."""
    return WifiClient(options, world, seed=seed, radios=radios)
