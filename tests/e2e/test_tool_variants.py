"""A trial on robots with any variant of their tools is valid, or is rejected before its first repeat."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import pytest

from tests.helpers.labs import copy_shipped
from tests.helpers.runs import Run, only_trial, rows, run_here

pytestmark = pytest.mark.emulated

SITE: Final = """\
backend: emulated
robots:
  one: {{profile: one}}
  two: {{profile: two}}
roles:
  masterless: {{sender: one, receiver: two}}
emulated:
  ros: {ros}
  late_bound: 2s
  radio: {{fading: false}}
  robots:
    one: {{{one}}}
    two: {{{two}}}
"""
ROSBAG: Final = ()
SQLITE3: Final = ("variant: ros1", "variant: ros2")
MCAP: Final = (
    *("variant: ros1", "variant: ros2", "distribution: foxy", "distribution: jazzy"),
    *("/opt/ros/foxy", "/opt/ros/jazzy", "_0.db3", "_0.mcap"),
)
# These parts of the procedure take time and do not depend on the variant.
SHORTER: Final = (
    *("count: 10", "count: 5", "interval: 200ms", "interval: 100ms"),
    *("topology: master", "topology: masterless"),
)


@dataclass(frozen=True)
class Pair:
    """The tools of two robots in the site file, changes of the sender's profile, and the choice of ROS."""

    sender: str
    receiver: str
    recorder: tuple[str, ...] = ROSBAG
    ros: str = "builtin"


def trial(lab: Path, pair: Pair, *words: str) -> Run:
    """Run a short trial in a lab of two robots with any variant of netcat, whose command is `nc`."""
    for name, recorder in (("one", pair.recorder), ("two", ROSBAG)):
        changes = ("name: turtlebot3_burger", f"name: {name}", "netcat: nc.traditional", "netcat: nc", *recorder)
        copy_shipped(lab, "robots", "turtlebot3_burger", *changes, called=name)
    copy_shipped(lab, "procedures", "los", *SHORTER)
    (lab / "fieldkit.yaml").write_text(
        SITE.format(one=pair.sender, two=pair.receiver, ros=pair.ros), encoding="utf-8"
    )
    return run_here(lab, "trial", "los", "5m", "--repeats", "1", "--record", "1s", *words)


@pytest.mark.parametrize(
    "pair",
    [
        Pair("netcat: openbsd, ssh: dropbear", "netcat: openbsd, sftp: false", recorder=SQLITE3),
        Pair("netcat: ncat, ping: busybox", "netcat: ncat, ssh: dropbear, sftp: false", recorder=MCAP),
        Pair(
            "netcat: traditional, userland: busybox",
            "netcat: openbsd, userland: busybox, ssh: dropbear",
            ros="debian",
        ),
        pytest.param(Pair("netcat: ncat", "netcat: openbsd"), marks=pytest.mark.nightly),
    ],
    ids=lambda pair: f"{pair.sender} to {pair.receiver}",
)
def test_a_trial_is_valid(tmp_path: Path, pair: Pair) -> None:
    run = trial(tmp_path, pair)
    assert run.code == 0, run.out + run.err
    assert "the link is lost" not in run.out + run.err, (
        "no action of fieldkit may cause a server to close its connection"
    )
    table = rows(only_trial(tmp_path))
    assert [(row["protocol"], row["attempt"], row["status"]) for row in table] == [
        ("tcp", "1", "valid"),
        ("udp", "1", "valid"),
    ], run.out + run.err
    for row in table:
        assert row["hash_match"] == "true", "this radio loses no packets"
        assert int(row["bag_messages"]) > 0
        assert row["rtt_received"] == row["rtt_sent"] == "5"


def test_busybox_sends_and_receives_by_tcp(tmp_path: Path) -> None:
    userland_keys = "userland: busybox, ssh: dropbear, sftp: false"
    run = trial(tmp_path, Pair(userland_keys, userland_keys), "--protocol", "tcp")
    assert run.code == 0, run.out + run.err
    (row,) = rows(only_trial(tmp_path))
    assert (row["status"], row["hash_match"]) == ("valid", "true")


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        (Pair("netcat: busybox", "netcat: openbsd"), ("one: tools: busybox nc has no UDP", "netcat-traditional")),
        (Pair("netcat: openbsd", "netcat: traditional"), ("two: tools: its netcat truncates", "netcat-openbsd")),
    ],
    ids=lambda value: f"{value.sender} to {value.receiver}" if isinstance(value, Pair) else "",
)
def test_unsuitable_tools_are_rejected_before_repeat_1(tmp_path: Path, pair: Pair, words: tuple[str, str]) -> None:
    run = trial(tmp_path, pair)
    assert run.code == 3, run.out + run.err
    tool, package = words
    assert tool in run.err
    assert f"  apt-get install {package}" in run.err, "root needs no sudo"
    assert rows(only_trial(tmp_path)) == [], "no repeat was started"
