"""The loss of MAVLink messages behind a router, compared with counters of the kernel, which drops messages."""

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
MAX_DIFFERENCE = 2 * len(REQUESTED)
"""Maximum difference: a message of each stream may be in flight when counting starts, and another when it stops."""


@pytest.mark.quiet
@pytest.mark.parametrize("percent", mark_nightly([20, 0]))
def test_loss_behind_a_router_equals_that_of_the_kernel(percent: int, tmp_path: Path) -> None:
    log = tmp_path / "mavlink.tlog"
    command = ("unshare", "--net", "--", sys.executable, "-m", "tests.helpers.mavlink_loss")
    completed = subprocess.run(
        (*command, str(log), str(DURATION_S), str(percent)),
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert completed.returncode == 0, completed.stderr
    counters = json.loads(completed.stdout)
    assert counters["periodic"] > 200
    assert counters["withheld"] > 10, "sequence numbers have gaps that are not losses"
    values = tlog.measure(tlog.read(log, drones.SYSTEM, counters["ended_us"], REQUESTED), 0.0).values
    n_received, n_sent = int(values["mavlink_periodic"]), int(values["mavlink_periodic_sent"])
    assert abs(n_sent - n_received - counters["dropped"]) <= MAX_DIFFERENCE
    assert n_received >= counters["periodic"] - counters["dropped"]
    assert float(values["mavlink_loss"]) == pytest.approx(1 - n_received / n_sent)
    assert float(values["mavlink_loss_most"]) > float(values["mavlink_loss"])
