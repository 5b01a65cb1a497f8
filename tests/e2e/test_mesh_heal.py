"""Six robots in a row of which only neighbours hear each other, with two ways past the middle: one is lost.

`fieldkit trial mesh_heal`, and what its row then says.
"""

from pathlib import Path

import pytest

from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.headers import ICMP
from tests.helpers.labs import BOX, copy_shipped
from tests.helpers.runs import fieldkit, only_trial, rows

pytestmark = pytest.mark.emulated

HELLO_S = 0.3
# babeld 1.12.1 (neighbour.c): a neighbour of which 12 hellos in a row are missing costs infinity; the first is
# missing 1.7 intervals after the last one that came, and babeld looks once an interval.
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
  mesh: {{daemon: babeld, hello: {HELLO_S}s}}
"""


def test_packets_go_another_way_within_babels_bound_and_the_row_says_so(tmp_path: Path) -> None:
    (tmp_path / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "box.yaml").write_text(BOX, encoding="utf-8")
    shorter = (
        "for: 70s",
        "for: 6s",
        "after: 5s",
        "after: 2s",
        "duration: 40s",
        "duration: 5s",
        "duration: 25s",
        "duration: 2s",
    )
    copy_shipped(tmp_path, "procedures", "mesh_heal", *shorter, "count: 750", "count: 80")
    run = fieldkit(tmp_path, "trial", "mesh_heal", "220m", "--repeats", "1")
    assert run.code == 0, run.out + run.err
    trial = only_trial(tmp_path)
    row = next(one for one in rows(trial) if one["status"] == "valid")
    gap_s, lost = float(row["rtt_gap_s"]), int(row["rtt_gap_lost"])
    assert HELLO_S < gap_s < BOUND_S
    assert lost == int(row["rtt_sent"]) - int(row["rtt_received"])
    assert gap_s == pytest.approx((lost + 1) * 0.1, abs=0.3)
    folder = trial / "repeats" / "udp-01"
    # Three robots forward on either way, so nobody hears farther than its neighbours; packets of the way that was not
    # lost are in the capture of the robot there.
    assert (folder / "ping.txt").read_text(encoding="utf-8").count("ttl=61") == int(row["rtt_received"])
    packets = pcap.read(folder / "middle.pcap").packets
    assert (packets.protocol == ICMP).any()
