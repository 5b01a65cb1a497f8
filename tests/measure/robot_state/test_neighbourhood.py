"""Other networks and their airtime on a channel: real outputs of several versions of `iw`, and invalid outputs."""

from datetime import UTC, datetime
from pathlib import Path

import pytest

from fieldkit.core.columns import Measured
from fieldkit.core.model import Protocol, Role, Topology
from fieldkit.core.units import parse_distance
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.robot_state import attempt_states, neighbourhood
from fieldkit.measure.robot_state.neighbourhood import RadioState, WifiChannel
from fieldkit.measure.robot_state.snapshots import SourceOutput
from fieldkit.trial.procedure import load_procedure
from fieldkit.trial.request import TrialRequest, make_plan
from tests.helpers.casts import CAST
from tests.helpers.paths import DATA
from tests.helpers.plans import problems

INFO = "Interface wlan0\n\taddr 02:00:00:00:01:00\n\tssid lab\n\ttype managed\n\tchannel {0}\n\ttxpower 20.00 dBm\n"
CHANNEL_1 = "1 (2412 MHz), width: 20 MHz, center1: 2412 MHz"
CHANNEL_6 = "6 (2437 MHz), width: 40 MHz, center1: 2447 MHz"
CHANNEL_36 = "36 (5180 MHz), width: 80 MHz, center1: 5210 MHz"


def text(name: str) -> str:
    return (DATA / "iw" / f"{name}.txt").read_text(encoding="utf-8").strip("\n")


def parse(info: str = "", scan: str | None = None, survey: str = "", reg: str = "") -> RadioState:
    outputs = {"iw-info": info, "iw-survey": survey, "iw-reg": reg} | ({} if scan is None else {"iw-scan": scan})
    return neighbourhood.parse({name: SourceOutput(output, 0) for name, output in outputs.items()})


def survey(*times: tuple[int, int, int | None]) -> str:
    """Return outputs of a survey with active, busy and transmit times in ms."""
    return "\n==\n".join(
        "Survey data from wlan0\n\tfrequency:\t\t\t2412 MHz\n\tchannel active time:\t\t9 ms\n"
        "\tchannel busy time:\t\t9 ms\n"
        f"Survey data from wlan0\n\tfrequency:\t\t\t2437 MHz [in use]\n\tnoise:\t\t\t\t-95 dBm\n"
        f"\tchannel active time:\t\t{active} ms\n\tchannel busy time:\t\t{busy} ms"
        + ("" if transmit is None else f"\n\tchannel transmit time:\t\t{transmit} ms")
        for active, busy, transmit in times
    )


@pytest.mark.parametrize(
    ("info", "channel"),
    [
        (text("info-ap"), WifiChannel(1, 2412, 20, 2412)),
        (text("info-txpower"), WifiChannel(1, 2412, 20, 2412)),
        (text("info-hwsim-station-6"), WifiChannel(6, 2437, 20, 2437)),
        (INFO.format(CHANNEL_36), WifiChannel(36, 5180, 80, 5210)),
        (text("info-hwsim-down-5"), None),
        (text("no-wifi"), None),
    ],
)
def test_the_channel_of_a_radio_is_parsed(info: str, channel: WifiChannel | None) -> None:
    assert parse(info).channel == channel


@pytest.mark.parametrize(
    ("channel", "scan", "signals_dbm"),
    [
        (CHANNEL_1, "scan-qca9377", (-27.0,)),  # 2417 MHz overlaps, 5745 MHz does not
        (CHANNEL_6, "scan-qca9377", ()),
        (CHANNEL_6, "scan-hwsim-5", (-30.0,)),
        (CHANNEL_6, "scan-6", (-31.0,)),
        ("11 (2462 MHz), width: 20 MHz, center1: 2462 MHz", "scan-station", ()),  # its network
    ],
)
def test_other_networks_on_the_channel_are_counted(channel: str, scan: str, signals_dbm: tuple[float, ...]) -> None:
    assert parse(INFO.format(channel), text(scan)).signals_dbm == signals_dbm


def test_networks_of_the_lab_and_old_scan_results_are_omitted() -> None:
    network = "BSS {0}(on wlan0){1}\n\tfreq: 2412\n\tsignal: {2} dBm\n\tlast seen: {3} ms ago"
    scan = "\n".join(
        (
            network.format("02:00:00:00:01:00", "", "-10.00", 0),
            network.format("02:00:00:00:01:02", " -- joined", "-20.00", 55242),
            network.format("02:00:00:00:01:03", "", "-30.00", 55242),
            network.format("02:00:00:00:01:04", "", "0.00", 10),
            network.format("02:00:00:00:01:05", "", "-50.00", 10),
            network.format("not an address", "", "-60.00", 10),
        )
    )
    assert parse(INFO.format(CHANNEL_1), scan).signals_dbm == (None, -50.0)


def test_a_failed_scan_is_unknown_and_an_empty_scan_has_no_networks() -> None:
    info = SourceOutput(INFO.format(CHANNEL_1), 0)
    for scan in (SourceOutput("command failed: Operation not permitted (-1)", 255), SourceOutput("", 137)):
        assert neighbourhood.parse({"iw-info": info, "iw-scan": scan}).signals_dbm is None
    assert parse(INFO.format(CHANNEL_1), "").signals_dbm == ()
    assert parse(text("info-hwsim-down-5"), text("scan-qca9377")).signals_dbm is None


@pytest.mark.parametrize(
    ("outputs", "share"),
    [
        (survey((1000, 500, 100), (1500, 800, 150)), 0.5),
        (survey((1000, 500, None), (1500, 600, None)), 0.2),
        (survey((0, 0, 0), (500, 0, 0)), 0.0),
        (survey((1000, 500, 100), (1000, 500, 100)), None),  # counters that do not change
        (survey((1000, 500, 100), (400, 300, 50)), None),  # counters that were reset
        (survey((1000, 500, 100), (1500, 520, 150)), None),  # more own transmissions than busy time
        (survey((1000, 500, 100)), None),
        (text("survey-ath10k-4"), None),
        ("", None),
    ],
)
def test_airtime_of_other_networks(outputs: str, share: float | None) -> None:
    assert parse(survey=outputs).others_share == (None if share is None else pytest.approx(share))


def test_the_regulatory_domain_is_parsed() -> None:
    assert parse(reg=text("reg-ath10k-ct")).country == "HR"
    assert parse(reg=text("reg-balena")).country == "00"
    assert parse(reg="command failed: No such file or directory (-2)").country is None


def write(folder: Path, snapshot: str, channel: str, busy_ms: int, *, role: str = "sender") -> None:
    outputs = {"iw-info": INFO.format(channel), "iw-survey": survey((0, 0, 0), (500, busy_ms, 0))}
    outputs |= {"iw-scan": text("scan-hwsim-5"), "iw-reg": text("reg-ath10k-ct")}
    lines = "".join(
        f"==> {name} <==\n" + "".join(f" {line}\n" for line in (*output.split("\n"), "code 0"))
        for name, output in outputs.items()
    )
    (folder / f"{role}-sources-{snapshot}.txt").write_text(lines, encoding="utf-8")


def test_a_busy_channel_marks_the_repeat(tmp_path: Path) -> None:
    write(tmp_path, "before", CHANNEL_6, 50)
    write(tmp_path, "after", CHANNEL_6, 300)
    robot_names = {Role.SENDER: "rover-1"}
    measured = attempt_states.measure(AttemptEvidence(tmp_path), robot_names, Measured())
    assert measured.values == {
        "marks": "busy channel",
        "marks_reason": "rover-1: others use 60 % of the airtime on channel 6",
        "sender_channel": "6 (2437 MHz), width 40 MHz",
        "sender_regulatory_domain": "HR",
        "sender_other_networks": 1,
        "sender_other_networks_max_dbm": -30.0,
        "sender_others_airtime_share": pytest.approx(0.6),
    }
    assert list(attempt_states.problems(AttemptEvidence(tmp_path), robot_names, {})) == []


def test_a_changed_channel_is_a_problem(tmp_path: Path) -> None:
    write(tmp_path, "before", CHANNEL_1, 0)
    write(tmp_path, "after", CHANNEL_6, 0)
    (problem,) = attempt_states.problems(AttemptEvidence(tmp_path), {Role.SENDER: "rover-1"}, {})
    assert problem == (
        "rover-1: the channel of its radio changed during the repeat, from 1 (2412 MHz), width 20 MHz to "
        "6 (2437 MHz), width 40 MHz"
    )


def test_another_channel_than_at_the_start_of_the_trial_is_a_problem(tmp_path: Path) -> None:
    write(tmp_path, "before", CHANNEL_6, 0)
    write(tmp_path, "after", CHANNEL_6, 0)
    robot_names = {Role.SENDER: "rover-1"}
    same_state, other_state = {"regulatory_domain": "HR"}, {"channel": "1 (2412 MHz), width 20 MHz"}
    assert list(attempt_states.problems(AttemptEvidence(tmp_path), robot_names, {Role.SENDER: same_state})) == []
    (problem,) = attempt_states.problems(AttemptEvidence(tmp_path), robot_names, {Role.SENDER: other_state})
    assert problem == (
        "rover-1: the channel of its radio is 6 (2437 MHz), width 40 MHz, but it was 1 (2412 MHz), width 20 MHz at "
        "the start of the trial"
    )


@pytest.mark.parametrize(("procedure", "is_problem"), [("los", True), ("roam", False)])
def test_only_a_robot_that_roams_may_change_its_channel(tmp_path: Path, procedure: str, is_problem: bool) -> None:
    for role in ("sender", "receiver"):
        write(tmp_path, "before", CHANNEL_1, 0, role=role)
        write(tmp_path, "after", CHANNEL_6, 0, role=role)
    request = TrialRequest(load_procedure(procedure), parse_distance("5m"), topology=Topology.MASTERLESS, seed=1)
    cast = {role: CAST[role] for role in (Role.SENDER, Role.RECEIVER)}
    plan = make_plan(request, backend="field", cast=cast, now=datetime(2026, 11, 20, tzinfo=UTC))
    reasons = [
        reason for reason in problems(plan, Protocol.UDP, tmp_path) if "channel of its radio changed" in reason
    ]
    assert [reason.partition(":")[0] for reason in reasons] == (
        ["turtlebot-1", "turtlebot-2"] if is_problem else ["turtlebot-1"]
    )
