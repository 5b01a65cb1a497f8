"""The loss of MAVLink behind a router, compared with the counters of the kernel that dropped the messages."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from fieldkit.motion.logs import tlog
from tests.helpers import drones
from tests.helpers.nightly import mark_nightly
from tests.helpers.paths import ROOT

pytestmark = pytest.mark.emulated

DURATION_S = 6
REQUESTED = (("ATTITUDE", 50_000), ("LOCAL_POSITION_NED", 50_000))
EDGE = 2 * len(REQUESTED)
"""Messages that may differ: one of each stream is in flight when the counters begin, and one when they end."""


@pytest.mark.quiet
@pytest.mark.parametrize("percent", mark_nightly([20, 0]))
def test_loss_behind_a_router_is_that_of_the_kernel(percent: int, tmp_path: Path) -> None:
    log = tmp_path / "mavlink.tlog"
    words = ("unshare", "--net", "--", sys.executable, "-m", "tests.helpers.mavlink_loss")
    done = subprocess.run(
        (*words, str(log), str(DURATION_S), str(percent)),
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    counted = json.loads(done.stdout)
    assert counted["periodic"] > 200
    assert counted["withheld"] > 10, "numbers have gaps that are not losses"
    values = tlog.measure(tlog.read(log, drones.SYSTEM, counted["ended_us"], REQUESTED), 0.0).values
    received, sent = int(values["mavlink_periodic"]), int(values["mavlink_periodic_sent"])
    assert abs(sent - received - counted["dropped"]) <= EDGE
    assert received >= counted["periodic"] - counted["dropped"]
    assert float(values["mavlink_loss"]) == pytest.approx(1 - received / sent)
    assert float(values["mavlink_loss_most"]) > float(values["mavlink_loss"])
