"""Linux Wi-Fi on an emulated robot.

The robot joins an ad hoc cell or an 802.11s mesh, runs an access point (hostapd), or is a station (wpa_supplicant).
Above an ad hoc cell, it may have a mesh interface of batman-adv.
"""

import shutil
import subprocess
from ipaddress import IPv4Interface
from pathlib import Path
from typing import Final

from fieldkit.core.errors import RobotError
from sim_backends.emulated.medium.framing import mac_of
from sim_backends.emulated.robot import network
from sim_backends.emulated.robot.spec import STATE, WifiSpec

SSID: Final = "fieldkit"

_CHANNEL: Final = 1
_FREQUENCY_MHZ: Final = 2412
_CHANNEL_STEP_MHZ: Final = 5
_MAX_CHANNELS: Final = 11
"""Number of channels on which every regulatory domain permits probe requests."""
# Two radios that search for a cell at the same time would create two cells, so all radios join this fixed cell.
_CELL: Final = "02:66:69:65:6c:64"
_JOIN: Final = {
    "ad hoc": ("ibss", "join", SSID, str(_FREQUENCY_MHZ), "HT20", "fixed-freq", _CELL),
    "mesh point": ("mesh", "join", SSID, "freq", str(_FREQUENCY_MHZ), "HT20"),
}
_BATMAN_MTU_BYTES: Final = network.MTU_BYTES + 32
"""With the header of batman-adv, packets of the usual size need no fragments."""
_TIMEOUT_S: Final = 15.0
"""Timeout of `iw`, `nft` and `batctl`."""
_PRIORITY_RULES: Final = """\
table netdev fieldkit {{
    chain output {{
        type filter hook egress devices = {{ {interfaces} }} priority 0
        meta priority set 0:0107
    }}
}}
"""
"""nftables rules that assign all frames to access category VO (mac80211 reads 0x107 as the priority 7).

They include frames that Linux forwards as a router, as a bridge, or by batman-adv. The other categories would use
block-ACK sessions, in which mac80211 ignores the transmission attempts that the driver of the simulated radios
(mac80211_hwsim) reports. The driver has no queues per category, so the rules change nothing else.
"""

_ACCESS_POINT: Final = """\
interface={interface}
ssid={ssid}
hw_mode=g
channel={channel}
ieee80211n=1
wmm_enabled=1
wpa=2
wpa_key_mgmt={key_management}
ieee80211w={protection}
rsn_pairwise=CCMP
wpa_passphrase={passphrase}
"""
_STATION: Final = """\
network={{
    ssid="{ssid}"
    psk="{passphrase}"
    key_mgmt={key_management}
    ieee80211w={protection}
    scan_freq={frequencies_mhz}
{background_scan}}}
"""
_KEY_MANAGEMENT: Final = {"wpa2": "WPA-PSK", "wpa3": "SAE"}
_PROTECTION: Final = {"wpa2": 0, "wpa3": 2}
"""Protected management frames, 802.11w: none, or required as in WPA3."""

MONITOR: Final = "mon0"
"""Name of the monitor interface, which captures all frames that the radio receives or sends.

The radiotap header of a sent frame contains the number of its retransmissions.
"""
_INTERFACE_TYPES: Final = {"ad hoc": "ibss", "mesh point": "mp"}

_CONFIGURATION: Final = Path(STATE, "wifi.conf")
PROGRAMS: Final = {"access point": "hostapd", "station": "wpa_supplicant"}
"""Program of each mode that needs one."""
_CONNECTED: Final = {"access point": "AP-ENABLED", "station": "CTRL-EVENT-CONNECTED"}
"""Text that the program of a mode logs when it is ready."""


def bring_up(device: str, interface: str, address: str, wifi: WifiSpec) -> None:
    """Bring up loopback and a Wi-Fi interface in this process's network namespace.

    Args:
        device: Current name of the interface.
        interface: Interface with the robot's address: the Wi-Fi interface, which gets this name, or the mesh
            interface of batman-adv above it.
        address: The robot's address with the prefix length.
        wifi: Mode of the robot in the Wi-Fi network; the program of this mode is started later.

    Raises:
        RobotError: A tool rejected a setting.
    """
    network.disable_ipv6()
    radio = wifi.radio_interface(interface)
    if device != radio:
        network.run_ip(f"link set {device} name {radio}")
    if wifi.forwards:
        network.prepare_mesh(radio)
    _run("nft", "-f", "-", text=priority_rules(radio))
    if wifi.mode in _INTERFACE_TYPES:
        _run("iw", "dev", radio, "set", "type", _INTERFACE_TYPES[wifi.mode])
    if wifi.originator_s is not None:
        network.run_ip(f"link set {radio} mtu {_BATMAN_MTU_BYTES} up")
        for words in batctl_commands(interface, radio, wifi.originator_s):
            _run("batctl", *words)
        network.run_ip(f"link set {interface} address {mac_of(IPv4Interface(address).ip).hex(':')}")
    network.configure(interface, address)
    _join(radio, wifi)
    if wifi.has_monitor:
        _run("iw", "dev", radio, "interface", "add", MONITOR, "type", "monitor")
        network.run_ip(f"link set {MONITOR} up")


def priority_rules(*interfaces: str) -> str:
    """Return nftables rules that assign all frames that leave by these interfaces to access category VO."""
    return _PRIORITY_RULES.format(interfaces=", ".join(interfaces))


def batctl_commands(mesh_interface: str, radio: str, originator_s: float) -> tuple[tuple[str, ...], ...]:
    """Return the words of the `batctl` commands that create a mesh interface above a Wi-Fi interface."""
    mesh = ("meshif", mesh_interface)
    return (
        (*mesh, "interface", "create", "routing_algo", "BATMAN_IV"),
        (*mesh, "interface", "-M", "add", radio),
        (*mesh, "orig_interval", str(round(1000 * originator_s))),
    )


def switch_on(radio: str, wifi: WifiSpec) -> None:
    """Bring the Wi-Fi interface up again, and join the ad hoc cell or the mesh.

    Raises:
        RobotError: A tool rejected a setting.
    """
    if wifi.originator_s is None:
        network.switch_on(radio)
    else:
        network.switch_on_link(radio)  # the routes are those of the mesh interface, which stayed up
    _join(radio, wifi)


def _join(radio: str, wifi: WifiSpec) -> None:
    # In other modes, hostapd and wpa_supplicant connect.
    if wifi.mode in _JOIN:
        _run("iw", "dev", radio, *_JOIN[wifi.mode])


def prepare_command(interface: str, wifi: WifiSpec) -> tuple[str, ...]:
    """Write the configuration of the robot's hostapd or wpa_supplicant, and return its command line."""
    _CONFIGURATION.touch(mode=0o600)
    _CONFIGURATION.write_text(configuration(interface, wifi), encoding="ascii")
    program = PROGRAMS[wifi.mode]
    options = () if wifi.mode == "access point" else ("-i", interface, "-c")
    return (shutil.which(program) or program, *options, str(_CONFIGURATION))


def configuration(interface: str, wifi: WifiSpec) -> str:
    """Return the configuration of hostapd for an access point, and of wpa_supplicant for a station."""
    template = _ACCESS_POINT if wifi.mode == "access point" else _STATION
    return template.format(
        interface=interface,
        ssid=SSID,
        channel=_CHANNEL,
        frequencies_mhz=" ".join(
            str(_FREQUENCY_MHZ + _CHANNEL_STEP_MHZ * number) for number in range(min(wifi.channels, _MAX_CHANNELS))
        ),
        background_scan=f'    bgscan="{wifi.background_scan}"\n' if wifi.background_scan else "",
        passphrase=wifi.passphrase,
        key_management=_KEY_MANAGEMENT[wifi.security],
        protection=_PROTECTION[wifi.security],
    )


def is_connected(wifi: WifiSpec) -> bool:
    """Return True if the robot's program has reported that its access point is on, or that it is connected."""
    log = Path(STATE, f"{PROGRAMS[wifi.mode]}.log")
    return log.exists() and _CONNECTED[wifi.mode] in log.read_text(encoding="utf-8", errors="replace")


def _run(*argv: str, text: str = "") -> None:
    result = subprocess.run(argv, input=text, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    if result.returncode:
        raise RobotError(f"{argv[0]} rejected a setting: {result.stderr.strip()}", remedy=f"update {argv[0]}")
