"""Trials on emulated robots whose programs report a wrong clock, a throttled computer and a busy channel.

The row, the table and the report name these conditions, and `compare` rejects a comparison with the trial.
"""

from pathlib import Path

import pytest

from fieldkit.core.model import Role
from fieldkit.trial.stored import plans
from tests.helpers import texts
from tests.helpers.labs import write_procedure
from tests.helpers.runs import only_trial, rows, run_here

pytestmark = pytest.mark.emulated

PROCEDURE = texts.procedure(
    "pings", "- ping: {from: sender, to: receiver, count: 3, interval: 20ms}\n", protocols="udp"
)

SYNCHRONIZED = "echo 0A090002,10.9.0.2,2,1795950534.1,-0.0000025,0,0,-0.03,0.00,0.2,0.0004,0.0001,0.5,Normal"
SLOW = SYNCHRONIZED.replace("-0.0000025", "1.0132000")
IW = r"""
case "$*" in
"dev wlan0 info")
    printf 'Interface wlan0\n\taddr 02:00:00:00:01:00\n\ttype IBSS\n'
    printf '\tchannel 6 (2437 MHz), width: 20 MHz, center1: 2437 MHz\n'
    ;;
"reg get") printf 'global\ncountry DE: DFS-ETSI\n' ;;
"dev wlan0 scan freq 2437 passive")
    printf 'BSS 02:00:00:00:09:01(on wlan0)\n\tfreq: 2437\n\tsignal: -41.00 dBm\n\tlast seen: 10 ms ago\n'
    ;;
"dev wlan0 survey dump")
    read -r up _ </proc/uptime
    ms=$((${up%.*} * 1000 + 1${up#*.}0 - 1000))
    printf 'Survey data from wlan0\n\tfrequency:\t2437 MHz [in use]\n'
    printf '\tchannel active time:\t%s ms\n\tchannel busy time:\t%s ms\n' $ms $((ms * SHARE / 100))
    ;;
*) exit 1 ;;
esac
"""
"""A program `iw` for a radio on channel 6, on which other stations use SHARE per cent of the time."""


def lab(folder: Path, **scripts: str) -> Path:
    """Run a trial in a lab whose receiver has these programs; return the lab."""
    folder.mkdir()
    lines = "".join(
        f"        {name}: |\n" + "".join(f"          {line}\n" for line in script.strip().splitlines())
        for name, script in {"chronyc": SYNCHRONIZED, **scripts}.items()
    )
    sender = f"    turtlebot-1:\n      scripts: {{chronyc: '{SYNCHRONIZED}'}}\n"
    robots = f"  robots:\n{sender}    turtlebot-2:\n      scripts:\n{lines}"
    site = f"{texts.site()}emulated:\n  ros: builtin\n  late_bound: 2s\n{robots}"
    (folder / "fieldkit.yaml").write_text(site, encoding="utf-8")
    write_procedure(folder, PROCEDURE)
    run = run_here(folder, "trial", "pings", "5m", "--yes")
    assert run.code == 0, run.err
    return folder


def test_conditions_of_robots_are_named_and_not_compared(tmp_path: Path) -> None:
    normal_lab = lab(tmp_path / "plain", vcgencmd="echo throttled=0x50000", iw=IW.replace("SHARE", "5"))
    marked_lab = lab(tmp_path / "bad", chronyc=SLOW, vcgencmd="echo throttled=0x50005", iw=IW.replace("SHARE", "60"))
    (row,) = rows(only_trial(normal_lab))
    assert (row["marks"], row["marks_reason"]) == ("none", "")
    assert row["receiver_power_state"] == "normal", "it was throttled before this repeat"
    assert float(row["receiver_others_airtime_share"]) == pytest.approx(0.05, abs=0.05)
    assert (row["receiver_channel"], row["receiver_other_networks"]) == ("6 (2437 MHz), width 20 MHz", "1")
    assert row["receiver_regulatory_domain"] == "DE"
    plan = plans.read_plan(only_trial(normal_lab))
    assert plan.radios == {
        Role.RECEIVER: {"channel": row["receiver_channel"], "regulatory_domain": row["receiver_regulatory_domain"]}
    }
    (row,) = rows(only_trial(marked_lab))
    assert row["status"] == "valid"
    names = "wrong clock and under-voltage and throttled and busy channel"
    assert row["marks"] == names
    for reason in (
        "turtlebot-2 is off by 1.0 s, although chrony has the source 10.9.0.2",
        "turtlebot-2: the supply voltage is too low",
        "turtlebot-2: the processor is throttled (throttled)",
        "turtlebot-2: others use 60 % of the airtime on channel 6",
    ):
        assert reason in row["marks_reason"]
    table = run_here(marked_lab, "aggregate", "trials", "--format", "csv").out
    assert f"marks={names}" in table
    assert run_here(marked_lab, "report", "trials", "-o", "report.html").code == 0
    page = (marked_lab / "report.html").read_text(encoding="utf-8")
    assert "1 valid repeat marked" in page
    assert "turtlebot-2: others use" in page
    compare_run = run_here(tmp_path, "compare", "plain/trials", "bad/trials")
    assert compare_run.code == 2
    for name in names.split(" and "):
        assert f"marks, {name}: A has it in 0 of 1 repeats, B has it in 1 of 1" in compare_run.err
    clocks_run = run_here(marked_lab, "clocks")
    assert clocks_run.code == 1
    assert "the clocks of turtlebot-1 and turtlebot-2 differ by" in clocks_run.out, "their true offset is 0"
