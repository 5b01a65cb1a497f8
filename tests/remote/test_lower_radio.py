"""The Wi-Fi interface that a robot's sampler reads if the interface under test is above it."""

import subprocess
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

pytestmark = pytest.mark.emulated

TELEMETRY = ROOT / "fieldkit/remote/telemetry.sh"
INTERFACES = ("bat0/lower_wlan1", "bat0/lower_eth0", "wlan0/lower_wlan1", "eth0", "wlan1", "br0/lower_eth0")
RADIOS = ("wlan0", "wlan1")


@pytest.mark.parametrize(
    ("interface", "radio"), [("bat0", "wlan1"), ("wlan0", "wlan0"), ("eth0", "eth0"), ("br0", "br0"), ("-", "-")]
)
def test_the_radio_is_the_interface_or_the_one_below_it(interface: str, radio: str, tmp_path: Path) -> None:
    """`tmp_path` has the layout of /sys/class/net: `lower_NAME` is a link to the folder of NAME."""
    for path in INTERFACES:
        name, _, lower = path.partition("/lower_")
        (tmp_path / name).mkdir(exist_ok=True)
        if lower:
            (tmp_path / name / f"lower_{lower}").symlink_to(f"../{lower}")
    for name in RADIOS:
        (tmp_path / name / "phy80211").mkdir()
    functions = TELEMETRY.read_text(encoding="ascii").replace("/sys/class/net", str(tmp_path))
    result = subprocess.run(
        ["sh", "-c", f'{functions}\nfind_radio "$1" && echo "$radio"', "sh", interface],
        capture_output=True,
        text=True,
        check=True,
    )
    assert (result.stdout, result.stderr) == (f"{radio}\n", "")
