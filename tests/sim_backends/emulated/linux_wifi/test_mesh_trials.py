"""Trials in meshes of babeld and batman-adv on Linux's Wi-Fi in the virtual machine, as a user runs them."""

import csv
from dataclasses import dataclass
from pathlib import Path

import pytest

from fieldkit.cli import main
from sim_backends.emulated.linux_wifi.virtual_machine import ROOT_VARIABLE
from tests.helpers.paths import ROOT

pytestmark = [pytest.mark.emulated, pytest.mark.nightly]

SITE = """\
backend: emulated
emulated:
  wifi: linux
  ros: builtin
  world: open
  radio: {fading: false, shadowing_db: 0}
  mesh: {protocol: PROTOCOL, hello: 500ms}
robots:
  ground-1: {profile: mesh_bot}
  ground-2: {profile: mesh_bot}
  ground-3: {profile: mesh_bot}
roles:
  masterless: {sender: ground-1, receiver: ground-2, middle: ground-3}
"""
PROCEDURE = """\
name: mesh_ping
summary: "Mesh: ping over one relay"
scenario: los
topology: masterless
protocols: [udp]
repeats: 1
places:
  middle: {near: sender, towards: 70m}
steps:
  - wait: {duration: 20s}
  - capture:
      robots: [sender, receiver, middle]
      during:
        - ping: {from: sender, to: receiver, count: 20, interval: 100ms, payload_bytes: 56, forwarded: true}
"""
TELEMETRY = "telemetry: {sources: {mesh: {batctl: {interface: bat0}}}}\n"
FIRST_TTL = 64


@dataclass(frozen=True)
class Trial:
    """A trial with one repeat.

    Attributes:
        protocol: Protocol of the mesh.
        row: The row of the repeat.
        files: Folder of its files.
    """

    protocol: str
    row: dict[str, str]
    files: Path


def run_trial(folder: Path, protocol: str) -> Trial:
    (folder / "fieldkit.yaml").write_text(SITE.replace("PROTOCOL", protocol), encoding="utf-8")
    profile = (ROOT / "robots/turtlebot3_burger.yaml").read_text(encoding="utf-8")
    profile = profile.replace("name: turtlebot3_burger", "name: mesh_bot")
    for name, file, text in (
        ("robots", "mesh_bot.yaml", profile + (TELEMETRY if protocol == "batman-adv" else "")),
        ("procedures", "mesh_ping.yaml", PROCEDURE),
    ):
        (folder / name).mkdir()
        (folder / name / file).write_text(text, encoding="utf-8")
    assert main(["trial", "mesh_ping", "140m"]) == 0
    (table,) = folder.glob("trials/*/trial.csv")
    rows = csv.DictReader(table.read_text(encoding="utf-8").splitlines())
    row = next(row for row in rows if row["status"] == "valid")  # a void attempt is repeated
    return Trial(protocol, row, table.parent / "repeats/udp-01")


@pytest.fixture(scope="module", params=["babel", "batman-adv"])
def trial(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Trial:
    path = tmp_path_factory.mktemp("lab")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(ROOT_VARIABLE, str(ROOT / ".linux"))
        patch.chdir(path)
        return run_trial(path, request.param)


def test_packets_are_forwarded_by_the_robot_in_the_middle(trial: Trial) -> None:
    """The preflight checks accept the routing protocol and the interface under test; otherwise no row is valid."""
    received = int(trial.row["rtt_received"])
    assert received >= 16
    ttl = FIRST_TTL - (trial.protocol == "babel")  # batman-adv forwards below IP
    assert (trial.files / "ping.txt").read_text(encoding="utf-8").count(f"ttl={ttl} ") == received


def test_the_interface_under_test_is_that_of_the_protocol(trial: Trial) -> None:
    state = (trial.files / "sender-before.txt").read_text(encoding="utf-8")
    interface = {"babel": "wlan0", "batman-adv": "bat0"}[trial.protocol]
    assert f": {interface}: <" in state.partition("==> ip -s link <==")[2]


def test_the_columns_of_the_link_are_those_of_the_wifi_interface(trial: Trial) -> None:
    """With batman-adv, it is below the interface under test."""
    assert all(trial.row[f"{role}_signal_median_dbm"] for role in ("sender", "receiver"))


def test_telemetry_of_batctl_has_the_neighbours_in_range(trial: Trial) -> None:
    if trial.protocol == "babel":
        assert "sender_neighbours_min" not in trial.row
        return
    # The first query may precede the first originator message; the robot out of range is never a neighbour.
    assert {trial.row["sender_neighbours_min"], trial.row["receiver_neighbours_min"]} <= {"0", "1"}
    assert trial.row["sender_link_source"].startswith("mesh (batctl): neighbours")
