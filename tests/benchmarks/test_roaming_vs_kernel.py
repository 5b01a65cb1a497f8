"""Scans, associations, roaming and power save of fieldkit compared with recordings of Linux."""

from collections.abc import Callable
from statistics import fmean, median

import pytest

from benchmarks import kernel_recordings, roaming_lab
from benchmarks import kernel_roaming as kernel
from benchmarks import roaming_recordings as recordings
from benchmarks import roaming_vs_kernel as study
from benchmarks.roaming_recordings import Recording
from sim_backends.emulated.linux_wifi.virtual_machine import ROOT_VARIABLE
from sim_backends.radio.infrastructure import roaming
from tests.helpers.paths import ROOT


@pytest.fixture(scope="module")
def events() -> Callable[[str], Recording]:
    return lambda name: recordings.read(kernel_recordings.load(recordings.recording(name)))


def durations_s(intervals: list[recordings.Interval]) -> list[float]:
    return [end_s - start_s for start_s, end_s in intervals]


def test_scans_last_as_long_as_those_of_the_kernel(events: Callable[[str], Recording]) -> None:
    """The kernel's first absence has one channel if its preparation takes a tick, and so has the last one."""
    (step,) = events("scans").steps("associated scan with packets to the robot")
    kernel_absences, model_absences = recordings.absences(step), study.model_absences("64ms")
    assert len(kernel_absences) == len(model_absences) == 6
    for part in (kernel_absences, model_absences):
        assert median(durations_s(part)) == pytest.approx(0.128, rel=0.05)
    for number in (0, -1):
        assert kernel_absences[-1][number] - kernel_absences[0][number] == pytest.approx(
            model_absences[-1][number] - model_absences[0][number], rel=0.05
        )


def test_passive_scans_of_the_kernel_visit_one_channel_at_a_time(events: Callable[[str], Recording]) -> None:
    (step,) = events("scans").steps("associated scan passive")
    kernel_absences, model_absences = recordings.absences(step), study.model_absences("112ms")
    assert len(kernel_absences) == len(model_absences) == kernel.CHANNELS
    assert median(durations_s(model_absences)) == pytest.approx(median(durations_s(kernel_absences)), rel=0.03)


def test_frames_of_an_association_have_the_sizes_of_the_recording(events: Callable[[str], Recording]) -> None:
    complete = list(recordings.associations(events("associations")))
    sizes = {tuple(frame.size_bytes for frame in frames) for frames in complete}
    reassociation = tuple(step.size_bytes for step in (*roaming._OPEN, *roaming._REASSOCIATION, *roaming._HANDSHAKE))
    sae = tuple(step.size_bytes for step in (*roaming._SAE, *roaming._REASSOCIATION, *roaming._SAE_HANDSHAKE))
    assert {reassociation, sae} <= sizes


def test_losses_of_the_link_are_detected_at_the_times_of_the_kernel(events: Callable[[str], Recording]) -> None:
    """Both times are uniform in a second. The robots of fieldkit leave up to a beacon interval after a beacon."""
    losses = recordings.link_losses_s(events("associations"))
    assert {nulls for _, nulls, _ in losses} == {roaming._NULL_FRAMES}
    assert all(0.717 - 0.1 <= loss_s <= 1.717 for loss_s, _, _ in losses)
    model_s = [study.model_link_loss_s(seed) for seed in range(10)]
    assert fmean(model_s) == pytest.approx(fmean(loss_s for loss_s, _, _ in losses), abs=0.2)
    assert all(scan_s == pytest.approx(roaming._RECONNECT_NS / 1e9, abs=0.005) for _, _, scan_s in losses)


@pytest.mark.parametrize("name", kernel.SCANS)
def test_a_walk_has_the_handovers_of_the_kernel(name: str, events: Callable[[str], Recording]) -> None:
    (step,) = events("walks").steps(f"walk {name}")
    kernel_moves, model_moves = recordings.handovers(step), study.model_walk(name, 1)
    assert [new for _, new, _ in model_moves] == [new for _, new, _ in kernel_moves] == ["right"]
    assert model_moves[0][0] == pytest.approx(kernel_moves[0][0], abs=1)
    # The packets are 20 ms apart. Linux needs up to 35 ms more for programs on an emulated processor.
    assert 0.01 < model_moves[0][2] <= kernel_moves[0][2] + 0.02 < 0.1


@pytest.mark.parametrize("kind", study.DESTINATIONS)
def test_delays_of_a_sleeping_robot_have_the_distribution_of_the_kernel(
    kind: str, events: Callable[[str], Recording]
) -> None:
    kernel_s = recordings.delays_s(events("power-save"), kind)
    model_s = study.model_delays_s(study.DESTINATIONS[kind])
    # Critical value of the test of Kolmogorov and Smirnov at 1 %.
    bound = 1.63 * ((len(kernel_s) + len(model_s)) / (len(kernel_s) * len(model_s))) ** 0.5
    assert study.distance(kernel_s, model_s) < bound


def test_a_robot_of_the_kernel_sleeps_after_the_time_of_the_model(events: Callable[[str], Recording]) -> None:
    recording = events("power-save")
    times_s = recordings.awake_times_s(recording)
    assert len(times_s) > 100
    assert median(times_s) == pytest.approx(0.1, abs=0.008)  # two ticks
    assert max(recordings.delays_s(recording, "frequent packet")[3:]) < 0.02, "frequent packets keep it awake"


def test_the_distance_of_distributions() -> None:
    assert study.distance([1, 2, 3], [1, 2, 3]) == 0
    assert study.distance([1, 2], [3, 4]) == 1
    assert study.distance([1, 2, 3, 4], [1, 2, 3, 9]) == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("frame", "kind"),
    [
        (b"\x40" + bytes(30), "probe-request"),
        (b"\xb0" + bytes(25) + b"\x02" + bytes(4), "authentication-2"),
        (b"\x48\x10" + bytes(22), "null"),
        (b"\xc8\x10" + bytes(24), "null"),
        (b"\x88\x41" + bytes(40), "data"),
        (b"\x88\x02" + bytes(24) + b"\xaa\xaa\x03\0\0\0\x88\x8e" + b"\x02\x03\0\x75\x02" + b"\x00\x8a", "eapol-1"),
        (b"\x08\x01" + bytes(22) + b"\xaa\xaa\x03\0\0\0\x88\x8e" + b"\x02\x03\0\x75\x02" + b"\x01\x0a", "eapol-2"),
        (b"\x88\x02" + bytes(24) + b"\xaa\xaa\x03\0\0\0\x88\x8e" + b"\x02\x03\0\x75\x02" + b"\x13\xca", "eapol-3"),
        (b"\x88\x01" + bytes(24) + b"\xaa\xaa\x03\0\0\0\x88\x8e" + b"\x02\x03\0\x75\x02" + b"\x03\x0a", "eapol-4"),
        (b"\xd4" + bytes(9), "control-13"),
    ],
)
def test_kinds_of_frames(frame: bytes, kind: str) -> None:
    assert roaming_lab.frame_kind(frame) == kind


@pytest.mark.emulated
@pytest.mark.nightly
def test_the_scans_of_a_virtual_machine_are_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ROOT_VARIABLE, str(ROOT / ".linux"))
    (step,) = recordings.read(recordings.record("scans")).steps("associated scan passive")
    assert len(recordings.absences(step)) == kernel.CHANNELS
