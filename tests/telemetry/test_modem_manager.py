"""The source `modemmanager` with Debian's mmcli and a ModemManager that python-dbusmock provides."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.config import schema
from fieldkit.core.deadline import Deadline
from fieldkit.telemetry import laptop_telemetry, source_readings
from fieldkit.telemetry.telemetry_section import TelemetrySource
from tests.helpers.sshd import wait_until

SOURCE = schema.validate(
    schema.parse("at: laptop\nlimit: 60s\nmodemmanager: {modem: any}\n", source="source.yaml"), TelemetrySource
)
CONFIG = """\
<busconfig><type>system</type><auth>EXTERNAL</auth><listen>unix:path={bus}</listen>
<policy context="default"><allow send_destination="*" eavesdrop="true"/><allow eavesdrop="true"/>
<allow own="*"/><allow user="*"/></policy></busconfig>
"""
MOCK = Path(__file__).parents[1] / "helpers" / "mock_modem.py"


@pytest.fixture
def modem_bus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The system bus of mmcli, with one LTE modem."""
    assert shutil.which("mmcli") is not None, "install modemmanager: .ci/install --dev"
    bus, config, ready = tmp_path / "bus", tmp_path / "bus.conf", tmp_path / "ready"
    config.write_text(CONFIG.format(bus=bus), encoding="utf-8")
    address = f"unix:path={bus}"
    daemon = subprocess.Popen(("dbus-daemon", f"--config-file={config}", "--nofork"), stderr=subprocess.DEVNULL)
    mock = None
    try:
        wait_until(bus.exists, Deadline.after(60))
        # Only Debian's Python has dbusmock.
        environment = os.environ | {"DBUS_SYSTEM_BUS_ADDRESS": address}
        mock = subprocess.Popen(("/usr/bin/python3", str(MOCK), str(ready)), env=environment, stderr=sys.stderr)
        wait_until(lambda: ready.exists() or mock.poll() is not None, Deadline.after(60))
        assert mock.poll() is None
        monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", address)
        yield
    finally:
        for process in filter(None, (mock, daemon)):
            process.kill()
            process.wait()


@pytest.mark.usefixtures("modem_bus")
def test_the_values_of_a_modem_are_read() -> None:
    readings = source_readings.parse(laptop_telemetry.query_once(SOURCE, {}), SOURCE)
    assert readings.values == (
        {
            "signal_dbm": -97.0,
            "sinr_db": 12.4,
            "band": "lte, EARFCN 1575",
            "cell": "26202 01A2D001",
            "neighbours": 2.0,
        },
    )


def test_without_modem_manager_there_is_no_value(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", f"unix:path={tmp_path}/nothing")
    readings = source_readings.parse(laptop_telemetry.query_once(SOURCE, {}), SOURCE)
    assert readings.values == ()
    assert readings.reason.startswith("mmcli failed with exit code 1: error: couldn't get bus")
