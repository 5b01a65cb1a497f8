"""`fieldkit trial mesh_heal` with six robots in a row, and its row in the table.

Only neighbours are in range, and there are two routes through the middle, one of which is lost.
"""

from pathlib import Path

import pytest

from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.headers import ICMP
from tests.helpers.labs import BOX, copy_shipped
from tests.helpers.runs import only_trial, rows, run_here

pytestmark = pytest.mark.emulated

HELLO_S = 0.3
# babeld 1.12.1 (neighbour.c): the cost of a neighbour is infinite after 12 consecutive missing hellos. The first is
# missing 1.7 intervals after the last received hello, and babeld checks once per interval.
BOUND_S = (1.7 + 11 + 1) * HELLO_S

SITE = f"""\
backend: emulated
robots:
  r1: {{profile: box}}
  r2: {{profile: box}}
  r3: {{profile: box}}
  r4: {{profile: box}}
  r5: {{profile: box}}
  r6: {{profile: box}}
roles:
  masterless: {{sender: r1, receiver: r6, first: r2, middle: r3, left: r4, last: r5}}
emulated:
  ros: builtin
  world: open
  radio: {{fading: false}}
  mesh: {{protocol: babel, hello: {HELLO_S}s}}
"""


def test_packets_are_rerouted_within_the_bound_of_babel_and_the_row_has_the_gap(tmp_path: Path) -> None:
    (tmp_path / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "box.yaml").write_text(BOX, encoding="utf-8")
    shorter_durations = (
        "for: 70s",
        "for: 6s",
        "after: 5s",
        "after: 2s",
        "duration: 40s",
        "duration: 5s",
        "duration: 25s",
        "duration: 2s",
    )
    copy_shipped(tmp_path, "procedures", "mesh_heal", *shorter_durations, "count: 750", "count: 80")
    run = run_here(tmp_path, "trial", "mesh_heal", "220m", "--repeats", "1")
    assert run.code == 0, run.out + run.err
    trial = only_trial(tmp_path)
    row = next(row for row in rows(trial) if row["status"] == "valid")
    gap_s, lost_count = float(row["rtt_gap_s"]), int(row["rtt_gap_lost"])
    assert HELLO_S < gap_s < BOUND_S
    assert lost_count == int(row["rtt_sent"]) - int(row["rtt_received"])
    assert gap_s == pytest.approx((lost_count + 1) * 0.1, abs=0.3)
    folder = trial / "repeats" / "udp-01"
    # On both routes, three robots forward the packets, so only neighbours are in range. The capture of the robot on
    # the
    # remaining route contains packets.
    assert (folder / "ping.txt").read_text(encoding="utf-8").count("ttl=61") == int(row["rtt_received"])
    packets = pcap.read(folder / "middle.pcap").packets
    assert (packets.protocol == ICMP).any()
