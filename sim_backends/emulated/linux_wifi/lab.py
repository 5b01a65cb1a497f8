"""Linux Wi-Fi in an emulated lab: the Wi-Fi settings of each robot, its radio, and the medium of all radios."""

import secrets
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TypeVar

from fieldkit.backends.protocols import Robot
from fieldkit.core.model import Role
from fieldkit.lab.robots import LabRobot
from sim_backends.emulated.linux_wifi.linux_wifi_options import LinuxWifiOptions
from sim_backends.emulated.linux_wifi.radios import HwsimRadio, require_radios
from sim_backends.emulated.linux_wifi.wifi_client import WifiClient
from sim_backends.emulated.robot.mesh_options import MeshOptions
from sim_backends.emulated.robot.spec import WifiSpec
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import World

Key = TypeVar("Key")

_PASSPHRASE_BYTES = 12


def wifi_specs(
    robots: Mapping[Key, Robot | LabRobot],
    settings: LinuxWifiOptions,
    radio: RadioOptions,
    mesh: MeshOptions | None = None,
) -> dict[Key, WifiSpec]:
    """Return the Wi-Fi settings of each robot.

    In an 802.11s mesh, all robots are mesh points. In a mesh of another protocol, all robots join an ad hoc cell. If
    there are access points that are not robots, all robots are stations of these. Otherwise the relay of a trial runs
    the access point; without a relay, all robots join an ad hoc cell.

    Args:
        robots: The robots.
        settings: The key `linux_wifi`.
        radio: The key `radio`.
        mesh: The key `mesh`.
    """
    if settings.mesh:
        return dict.fromkeys(robots, WifiSpec("mesh point", has_monitor=settings.monitor))
    station = WifiSpec("station", secrets.token_hex(_PASSPHRASE_BYTES), settings.security, settings.monitor)
    if radio.access_points:
        roaming = radio.roaming
        # The module `simple` of wpa_supplicant: a short interval below a signal threshold, a long one above it.
        scan = f"simple:{roaming.short:.0f}:{roaming.threshold_dbm:.0f}:{roaming.long:.0f}"
        return dict.fromkeys(robots, replace(station, background_scan=scan, channels=roaming.channels))
    ad_hoc = WifiSpec("ad hoc", has_monitor=settings.monitor)
    if mesh is not None and mesh.protocol == "batman-adv":
        return dict.fromkeys(robots, replace(ad_hoc, originator_s=mesh.hello_s))
    if mesh is not None or Role.RELAY not in robots:
        return dict.fromkeys(robots, replace(ad_hoc, forwards=mesh is not None))
    return {key: replace(station, mode="access point") if key == Role.RELAY else station for key in robots}


def radios_of(robots: Iterable[Robot | LabRobot], options: RadioOptions) -> dict[str, HwsimRadio]:
    """Return the radio of each robot and access point by its name. Raises the errors of `require_radios`."""
    names = [*(robot.name for robot in robots), *options.access_points]
    return dict(zip(names, require_radios(len(names)), strict=True))


def medium(
    options: RadioOptions, world: World, seed: int, radios: Mapping[str, HwsimRadio], wifi: Iterable[WifiSpec]
) -> WifiClient:
    """Return the medium of the radios, for robots with these settings. Raises the errors of `WifiClient`."""
    # Settings of stations matter only for access points that are not robots; then all robots have the same settings.
    return WifiClient(options, world, seed=seed, radios=radios, station=next(iter(wifi)))
