"""The script that flies a user's simulated firmware, tested with the emulated ArduCopter."""

from itertools import islice

from benchmarks.firmware_flights import rows
from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from tests.helpers import drones


def test_the_autopilot_passes_the_first_cases_of_the_comparison() -> None:
    with drones.autopilot_at_udp(firmware=ARDUCOPTER, boot_s=1.0) as (port, autopilot):
        results = list(islice(rows(f"udpout:127.0.0.1:{port}"), 3))
        assert [(row.case, row.passed, row.observation if not row.passed else "") for row in results] == [
            ("can be armed", True, ""),
            ("telemetry is recorded", True, ""),
            ("out and back", True, ""),
        ]
        assert not autopilot.vehicle.is_armed
