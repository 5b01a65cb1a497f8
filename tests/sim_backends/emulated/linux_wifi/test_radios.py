"""Radios of hwsim among the wireless devices of a kernel."""

import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from fieldkit.core.errors import ConfigurationError
from sim_backends.emulated.linux_wifi import radios
from sim_backends.emulated.linux_wifi.radios import HwsimRadio, find_radios


def add_device(root: Path, number: int, driver: str, *interfaces: str) -> None:
    """Add a device; the names of monitor interfaces begin with `mon`."""
    device = root / "devices" / f"device{number}"
    (device / "net").mkdir(parents=True)
    for interface in interfaces:
        (device / "net" / interface).mkdir()
        (device / "net" / interface / "type").write_text("803\n" if interface.startswith("mon") else "1\n")
    (root / "class" / driver).mkdir(parents=True, exist_ok=True)
    (device / "subsystem").symlink_to(root / "class" / driver)
    phy = root / "ieee80211" / f"phy{number}"
    phy.mkdir(parents=True)
    (phy / "device").symlink_to(device)
    (phy / "macaddress").write_text(f"02:00:00:00:{number:02x}:00\n")


def test_only_radios_of_hwsim_with_an_interface_are_used_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    add_device(tmp_path, 0, "pci", "wlp1s0")
    add_device(tmp_path, 10, "mac80211_hwsim", "wlan2")
    add_device(tmp_path, 2, "mac80211_hwsim", "wlan1")
    add_device(tmp_path, 3, "mac80211_hwsim")
    add_device(tmp_path, 4, "mac80211_hwsim", "mon0", "wlan3")
    assert find_radios(tmp_path / "ieee80211") == [
        HwsimRadio("phy2", "wlan1", "42:00:00:00:02:00"),
        HwsimRadio("phy4", "wlan3", "42:00:00:00:04:00", ("mon0",)),
        HwsimRadio("phy10", "wlan2", "42:00:00:00:0a:00"),
    ]
    assert find_radios(tmp_path / "missing") == []


def test_too_few_radios_are_an_error_with_the_command_that_adds_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(radios, "find_radios", lambda: [HwsimRadio("phy0", "wlan0", "42:00:00:00:00:00")])
    assert len(radios.require_radios(1, wait_s=0.0)) == 1
    with pytest.raises(ConfigurationError) as error_info:
        radios.require_radios(3, wait_s=0.0)
    assert "radios=3" in error_info.value.remedy


@pytest.mark.emulated
def test_link_mode_and_mtu_of_an_earlier_lab_are_reset() -> None:
    code = f"from {radios.__name__} import reset_link; reset_link('d0')"
    show = "ip -o link show d0"
    script = f"ip tuntap add d0 mode tap && ip link set d0 mtu 1532 mode dormant && {show}"
    script += f" && {shlex.join((sys.executable, '-c', code))} && {show}"
    output = subprocess.run(("unshare", "--net", "sh", "-c", script), capture_output=True, text=True, check=True)
    before, after = output.stdout.splitlines()
    assert "mtu 1532" in before
    assert "mode DORMANT" in before
    assert "mtu 1500" in after
    assert "mode DEFAULT" in after
