"""The Wi-Fi interface that a robot's sampler reads if the interface under test is above it."""

import os
import subprocess
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

pytestmark = pytest.mark.emulated

TELEMETRY = ROOT / "fieldkit/remote/telemetry.sh"
PROGRAMS = {
    "ip": """
case "$*" in
    "-o link show master bat0") echo "4: eth0: <UP> mtu 1500"; echo "5: wlan1: <UP> mtu 1532 master bat0" ;;
    "-o link show master br0") echo "6: eth1.2@eth1: <UP> mtu 1500 master br0" ;;
    "-o link show master wlan0") ;;
    *) echo "Device does not exist." >&2; exit 1 ;;
esac
""",
    "iw": """
case "$*" in "dev wlan"[01]" info") echo type IBSS ;; *) echo "No such device" >&2; exit 237 ;; esac
""",
}
"""Substitutes of the programs; ip prints the interfaces that have a master as iproute2 does."""


@pytest.mark.parametrize(
    ("interface", "radio"), [("bat0", "wlan1"), ("br0", "br0"), ("wlan0", "wlan0"), ("eth9", "eth9")]
)
def test_the_radio_is_the_interface_or_the_one_below_it(interface: str, radio: str, tmp_path: Path) -> None:
    for name, text in PROGRAMS.items():
        (tmp_path / name).write_text(f"#!/bin/sh{text}", encoding="ascii")
        (tmp_path / name).chmod(0o755)
    functions = TELEMETRY.read_text(encoding="ascii")
    result = subprocess.run(
        ["sh", "-c", f'SOURCE_S=60\n{functions}\nfind_radio "$1" && echo "$radio"', "sh", interface],
        env={"PATH": f"{tmp_path}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert (result.stdout, result.stderr) == (f"{radio}\n", "")
