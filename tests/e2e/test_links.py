"""Robots with several links: each step uses its link, and packets use another link if one is lost."""

from pathlib import Path

import pytest

from tests.helpers.labs import copy_shipped, write_procedure
from tests.helpers.runs import only_trial, rows, run_here

pytestmark = pytest.mark.emulated

SITE = """\
backend: emulated
robots:
  turtlebot-1: {profile: turtlebot3_burger}
  turtlebot-2: {profile: turtlebot3_burger}
roles:
  masterless: {sender: turtlebot-1, receiver: turtlebot-2}
emulated:
  ros: builtin
  late_bound: 2s
  mesh: {protocol: babel, hello: 0.3s}
  links:
    cell: {rate: 20Mbit/s, delay: 100ms}
"""
PROCEDURE = """\
name: two_links
summary: A transfer on each link, and a ping while the Wi-Fi is lost
scenario: los
topology: masterless
protocols: [tcp]
repeats: 1
steps:
  - capture:
      name: cell
      over: cell
      port: 1234
      during:
        - send: {name: cell, over: cell, from: sender, to: receiver, size: 20kB}
        - ping: {name: cell, over: cell, from: sender, to: receiver, count: 3, payload_bytes: 56}
  - ping: {name: wifi, over: wifi, from: sender, to: receiver, count: 3, payload_bytes: 56}
  - wait: {duration: 8s}
  - capture:
      name: any
      over: either
      during:
        - fault:
            robot: receiver
            kind: link-down
            link: wifi
            for: 8s
            after: 2s
            during:
              - ping:
                  over: either
                  from: sender
                  to: receiver
                  count: 110
                  interval: 100ms
                  payload_bytes: 56
                  gap: true
                  duplicates: true
                  links: [wifi, cell]
"""


def test_each_step_uses_its_link_and_packets_use_another_link_if_one_is_lost(tmp_path: Path) -> None:
    links = "links: {wifi: wlan0, cell: wwan0, either: lo}\n\nradio:"
    copy_shipped(tmp_path, "robots", "turtlebot3_burger", "radio:", links)
    (tmp_path / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    run = run_here(tmp_path, "trial", write_procedure(tmp_path, PROCEDURE), "10ft")
    assert run.code == 0, run.out + run.err
    (row,) = rows(only_trial(tmp_path))
    assert row["status"] == "valid"
    # The delay of 100 ms of the cellular link applies in both directions.
    assert float(row["cell.rtt_min_s"]) >= 0.2
    assert float(row["wifi.rtt_median_s"]) < 0.1
    assert float(row["cell.file_loss"]) == 0
    assert float(row["cell.transfer_s"]) >= 0.2
    assert float(row["cell.delay_propagation_s"]) >= 0.1
    # The Wi-Fi was lost for the 8 s of the fault; packets continued earlier over the cellular link.
    assert float(row["link_down_outage_s"]) >= 7.5
    assert 0.5 < float(row["rtt_gap_s"]) < 7.5
    assert float(row["rtt_min_s"]) < 0.1
    assert float(row["rtt_max_s"]) >= 0.2
    # babeld sends each packet over one link. The captures contain the packets of both.
    assert row["rtt_duplicates"] == "0"
    assert int(row["any.sender_captured"]) >= 110
    # Requests left over the Wi-Fi before and after the fault, and over the cellular link during it.
    sent = {link: int(row[f"rtt_over_{link}_sent"]) for link in ("wifi", "cell")}
    lost = {link: int(row[f"rtt_over_{link}_lost"]) for link in ("wifi", "cell")}
    assert sent["wifi"] >= 20
    assert sent["cell"] >= 10
    assert sum(sent.values()) <= 110
    assert lost["wifi"] >= 3, "babeld needs some time to detect the loss"
    assert lost["cell"] == 0
    failover_s = float(row["rtt_over_cell_failover_s"])
    assert failover_s == pytest.approx(float(row["rtt_gap_s"]), abs=0.35), "the delay over the two links differs"
    assert (row["rtt_over_wifi_duplicates"], row["rtt_over_cell_duplicates"]) == ("0", "0")
