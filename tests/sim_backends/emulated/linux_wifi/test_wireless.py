"""Wi-Fi specifications of robots by their roles, and the configurations of hostapd and wpa_supplicant."""

from collections.abc import Mapping
from types import MappingProxyType

import pytest

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import load_profile
from fieldkit.config.schema import ValidationError
from fieldkit.core.model import Role
from sim_backends.emulated.emulated_options import EmulatedOptions
from sim_backends.emulated.linux_wifi import access_points, lab
from sim_backends.emulated.robot import wireless
from sim_backends.emulated.robot.spec import WifiSpec

PROFILE = load_profile("turtlebot3_burger")
TRIO = {
    role: Robot(name=str(role), address=f"10.42.0.{number}", profile=PROFILE)
    for number, role in enumerate((Role.SENDER, Role.RECEIVER, Role.RELAY), start=1)
}
PAIR = {role: TRIO[role] for role in (Role.SENDER, Role.RECEIVER)}


RADIO = {
    "access_points": {"left": {"at_m": (0, 0)}, "right": {"at_m": (80, 0)}},
    "roaming": {"short": "5s", "threshold_dbm": -70, "long": "60s", "channels": 3},
}


def specs_of(
    robots: dict[Role, Robot],
    *,
    radio: Mapping[str, object] = MappingProxyType({}),
    mesh_of: Mapping[str, object] | None = None,
    **settings: object,
) -> dict[Role, WifiSpec]:
    keys = {"linux_wifi": settings, "radio": dict(radio), "mesh": mesh_of}
    options = EmulatedOptions.model_validate({"wifi": "linux", **keys})
    return lab.wifi_specs(robots, options.linux_wifi, options.radio, options.mesh)


def settings_of(text: str) -> dict[str, str]:
    """Return the settings in a configuration; wpa_supplicant indents those of a network."""
    lines = (line.strip().partition("=") for line in text.splitlines() if line.strip() not in {"network={", "}"})
    return {key: value for key, _, value in lines}


def test_the_relay_is_the_access_point_and_the_other_robots_have_its_passphrase() -> None:
    specs = specs_of(TRIO)
    assert [specs[role].mode for role in TRIO] == ["station", "station", "access point"]
    (passphrase,) = {spec.passphrase for spec in specs.values()}
    assert 8 <= len(passphrase) <= 63, "WPA-PSK, IEEE 802.11-2020, J.4.1"
    assert passphrase not in {spec.passphrase for spec in specs_of(TRIO).values()}, "a new one for each lab"
    assert {spec.mode for spec in specs_of(PAIR).values()} == {"ad hoc"}


@pytest.mark.parametrize("robots", [TRIO, PAIR], ids=["with a relay", "without"])
def test_in_a_mesh_all_robots_are_mesh_points(robots: dict[Role, Robot]) -> None:
    assert {(spec.mode, spec.passphrase) for spec in specs_of(robots, mesh=True).values()} == {("mesh point", "")}


@pytest.mark.parametrize("robots", [TRIO, PAIR], ids=["with a relay", "without"])
def test_in_a_mesh_of_another_protocol_all_robots_join_an_ad_hoc_cell(robots: dict[Role, Robot]) -> None:
    (babel,) = set(specs_of(robots, mesh_of={"protocol": "babel"}).values())
    assert (babel.mode, babel.forwards, babel.originator_s) == ("ad hoc", True, None)
    assert babel.radio_interface("wlan0") == "wlan0"
    (batman,) = set(specs_of(robots, mesh_of={"protocol": "batman-adv", "hello": "500ms"}).values())
    assert (batman.mode, batman.forwards, batman.originator_s) == ("ad hoc", False, 0.5)
    assert batman.radio_interface("bat0") == "wlan0"
    assert {spec.forwards for spec in specs_of(PAIR).values()} == {False}


def test_batctl_creates_the_mesh_interface_above_the_wifi_interface() -> None:
    commands = [" ".join(words) for words in wireless.batctl_commands("bat0", "wlan0", 0.5)]
    assert commands == [
        "meshif bat0 interface create routing_algo BATMAN_IV",
        "meshif bat0 interface -M add wlan0",
        "meshif bat0 orig_interval 500",
    ]


@pytest.mark.parametrize("mesh", [False, True])
@pytest.mark.parametrize("robots", [TRIO, PAIR], ids=["with a relay", "without"])
def test_either_all_robots_or_no_robots_have_the_monitor_interface(robots: dict[Role, Robot], *, mesh: bool) -> None:
    assert {spec.has_monitor for spec in specs_of(robots, mesh=mesh, monitor=True).values()} == {True}
    assert {spec.has_monitor for spec in specs_of(robots, mesh=mesh).values()} == {False}


@pytest.mark.parametrize(
    ("security", "key_management", "protection"), [("wpa2", "WPA-PSK", "0"), ("wpa3", "SAE", "2")]
)
def test_access_point_and_station_have_the_same_security(security: str, key_management: str, protection: str) -> None:
    specs = specs_of(TRIO, security=security)
    access_point = settings_of(wireless.configuration("wlan0", specs[Role.RELAY]))
    station = settings_of(wireless.configuration("wlan0", specs[Role.SENDER]))
    assert (access_point["wpa_key_mgmt"], access_point["ieee80211w"]) == (key_management, protection)
    assert (station["key_mgmt"], station["ieee80211w"]) == (key_management, protection)
    assert station["psk"] == f'"{access_point["wpa_passphrase"]}"'
    assert station["ssid"] == f'"{access_point["ssid"]}"'
    assert (access_point["interface"], access_point["channel"], station["scan_freq"]) == ("wlan0", "1", "2412")


def test_with_access_points_that_are_not_robots_all_robots_roam_between_them() -> None:
    specs = specs_of(PAIR, radio=RADIO)
    assert len(set(specs.values())) == 1
    station = specs[Role.SENDER]
    text = wireless.configuration("wlan0", station)
    assert 'bgscan="simple:5:-70:60"' in text
    assert settings_of(text)["scan_freq"] == "2412 2417 2422"
    access_point, other = (
        settings_of(access_points.configuration(f"wlan{number}", station, number)) for number in (7, 8)
    )
    assert access_point["beacon_int"] != other["beacon_int"], "beacons of hwsim would always collide"
    assert (access_point["interface"], access_point["bridge"]) == ("wlan7", access_points.BRIDGE)
    assert access_point["wpa_passphrase"] == station.passphrase
    assert "bgscan" not in wireless.configuration("wlan0", specs_of(TRIO)[Role.SENDER])


def test_a_mesh_and_access_points_cannot_be_combined() -> None:
    with pytest.raises(ValidationError, match=r"radio\.access_points"):
        specs_of(PAIR, radio=RADIO, mesh=True)


def test_unknown_security_is_refused() -> None:
    with pytest.raises(ValidationError, match="wpa2"):
        EmulatedOptions.model_validate({"wifi": "linux", "linux_wifi": {"security": "wep"}})
