"""A trial with a robot that drives away: its positions, the packets that reached it, and its rows."""

import csv
import signal
from itertools import pairwise
from pathlib import Path

import pytest

from fieldkit.config.profiles import load_profile
from fieldkit.core.model import Role, TrackPoint
from fieldkit.measure.evidence import track
from sim_backends.radio.antennas import antenna_of
from sim_backends.radio.phy.modes import N_MODES
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.world_channel import WorldChannel
from tests.helpers.paths import ROOT
from tests.helpers.runs import finish, only_trial, rows, run_here, start, wait_for_line
from tests.helpers.texts import site

pytestmark = pytest.mark.emulated

# Without fading and shadowing, the link ends at one distance.
SITE = site(
    {"turtlebot-1": "turtlebot3_burger", "duckiedrone-1": "quick"},
    emulated="ros: builtin, record_air: true, radio: {fading: false, shadowing_db: 0.0}",
)
PATH_M = 60.0
SPEED_M_S = 4.0
RATES = {mode.name: mode.rate_bit_s for mode in N_MODES}


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """A lab with a drone that is faster than the shipped one, and a procedure for it, to save time."""
    (tmp_path / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    for folder, old, new, changes in (
        ("robots", "duckiedrone", "quick", {"max_speed_m_s: 3.0": "max_speed_m_s: 4.0"}),
        ("procedures", "driveaway", "rush", {"speed: 2m/s": "speed: 4m/s"}),
    ):
        text = (ROOT / folder / f"{old}.yaml").read_text(encoding="utf-8")
        for old_text, new_text in (changes | {f"name: {old}": f"name: {new}"}).items():
            assert old_text in text
            text = text.replace(old_text, new_text)
        (tmp_path / folder).mkdir()
        (tmp_path / folder / f"{new}.yaml").write_text(text, encoding="utf-8")
    return tmp_path


def range_m() -> float:
    """Return the range of these two robots in the model, on open ground."""
    antennas = {name: antenna_of(load_profile(name).radio) for name in ("turtlebot3_burger", "duckiedrone")}
    channel = WorldChannel(1, antennas, RadioOptions(fading=False, shadowing_db=0.0))
    near_m, far_m = 1.0, 1000.0
    while far_m - near_m > 1e-3:
        middle_m = (near_m + far_m) / 2
        channel.move(0, {"turtlebot3_burger": (0.0, 0.0, 0.2), "duckiedrone": (middle_m, 0.0, 0.2)})
        near_m, far_m = (middle_m, far_m) if channel.are_linked(0, 1) else (near_m, middle_m)
    return near_m


def frames(folder: Path, points: tuple[TrackPoint, ...]) -> list[tuple[float, str, bool]]:
    """Return the distance, mode and success of each attempt to reach the receiver."""
    changes = track.distances_m(points, Role.SENDER, Role.RECEIVER)
    distances = [(utc_ns, metres) for utc_ns, metres in changes if metres is not None]
    with (folder / "air.csv").open(encoding="ascii", newline="") as file:
        lines = [line for line in csv.DictReader(file) if line["receiver"] == "duckiedrone-1"]
    attempts = [line for line in lines if line["attempt"] != "0"]  # 0 marks ACKs
    frame_results = []
    for line in attempts:
        metres = [metres for utc_ns, metres in distances if utc_ns <= int(line["start_ns"])][-1]
        frame_results.append((metres, line["mode"], "duckiedrone-1" in line["received"].split()))
    return frame_results


def test_the_link_slows_down_and_ends_at_the_distance_of_the_model(lab: Path) -> None:
    run = run_here(lab, "trial", "rush", "40m", "--repeats", "1", "--protocol", "udp", "--record", "1s")
    assert run.code == 0, run.err
    trial = only_trial(lab)
    (row,) = [row for row in rows(trial) if row["status"] == "valid"]
    (folder,) = (trial / "repeats").glob("udp-01")

    points = track.read(folder / "track.csv")
    receiver_track = [point for point in points if point.role is Role.RECEIVER]
    assert {point.position_m for point in points if point.role is Role.SENDER} == {(3.0, 6.0, 0.2)}
    east_m = [point.position_m[0] for point in receiver_track if point.position_m is not None]
    assert (east_m[0], max(east_m), east_m[-1]) == (43.0, 43.0 + PATH_M, 43.0), (
        "it drives out and returns to its start"
    )
    assert all(earlier < later for earlier, later in pairwise(east_m[:-1]))
    assert len(east_m) > PATH_M / 2, "positions along the whole path"
    assert {point.velocity_m_s for point in receiver_track[1:-2]} == {(SPEED_M_S, 0.0, 0.0)}
    assert receiver_track[-2].velocity_m_s == receiver_track[-1].velocity_m_s == (0.0, 0.0, 0.0)

    end_m = range_m()
    assert 60 < end_m < 40 + PATH_M, "the route leads out of range"
    sent_frames = frames(folder, points)
    received_m = [metres for metres, _, is_received in sent_frames if is_received]
    assert end_m - 10 < max(received_m) <= end_m
    nearest_m = min(metres for metres, _, _ in sent_frames)  # the robot already drives while the programs start
    near_bit_s, far_bit_s = (
        [RATES[mode] for metres, mode, _ in sent_frames if 0 <= metres - low_m <= 10]
        for low_m in (nearest_m, end_m - 10)
    )
    assert sum(near_bit_s) / len(near_bit_s) > 1.2 * sum(far_bit_s) / len(far_bit_s)

    assert 40 <= float(row["transfer_distance_start_m"]) <= float(row["transfer_distance_max_m"]) < 100
    assert float(row["transfer_relative_speed_m_s"]) == SPEED_M_S
    assert float(row["transfer_sender_speed_m_s"]) == 0
    assert (
        40 < float(row["rtt_distance_min_m"]) < float(row["rtt_distance_mean_m"]) < float(row["rtt_distance_max_m"])
    )
    assert float(row["rtt_loss"]) > 0
    assert int(row["rtt_received"]) > 0

    before = (trial / "trial.csv").read_bytes()
    assert run_here(lab, "rebuild", str(trial)).code == 0
    assert (trial / "trial.csv").read_bytes() == before
    assert run_here(lab, "verify", str(trial)).code == 0


def test_a_trial_that_is_stopped_during_the_move_records_that_it_was_interrupted(lab: Path) -> None:
    process = start(lab, "trial", "rush", "10m", "--repeats", "1", "--protocol", "tcp", "--record", "1s", "--json")
    wait_for_line(process, '"ping"')
    process.send_signal(signal.SIGTERM)
    run = finish(process)
    assert run.code == 130, run.err
    (row,) = rows(only_trial(lab))
    assert (row["status"], row["reason"]) == ("void", "interrupted")


def test_a_robot_that_is_too_slow_is_rejected_before_a_robot_moves(lab: Path) -> None:
    (lab / "fieldkit.yaml").write_text(SITE.replace("profile: quick", "profile: turtlebot3_burger"))
    path = lab / "procedures" / "rush.yaml"
    path.write_text(path.read_text().replace("      within_limits: true\n", ""))
    run = run_here(lab, "trial", "rush", "10m", "--repeats", "1")
    assert run.code == 3, run.err
    assert "its top speed is 0.22 m/s, but the move needs 4 m/s" in run.out + run.err
