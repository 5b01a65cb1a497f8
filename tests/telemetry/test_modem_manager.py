"""The source `modemmanager` with Debian's mmcli, against a ModemManager that python-dbusmock provides."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.config import schema
from fieldkit.telemetry import laptop_telemetry, source_readings
from fieldkit.telemetry.telemetry_section import TelemetrySource
from tests.helpers.telemetry_devices import modem_bus

SOURCE = schema.validate(
    schema.parse("at: laptop\nlimit: 60s\nmodemmanager: {modem: any}\n", source="source.yaml"), TelemetrySource
)


@pytest.fixture
def _modem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with modem_bus(tmp_path) as address:
        monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", address)
        yield


@pytest.mark.usefixtures("_modem")
def test_values_of_a_modem() -> None:
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
