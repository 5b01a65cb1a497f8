"""The minstrel_ht of fieldkit compared with recordings of minstrel_ht in Linux, on the same frames."""

from collections import Counter
from statistics import correlation
from typing import Any

import pytest

from benchmarks import kernel_recordings
from benchmarks import minstrel_vs_kernel as study
from benchmarks.kernel_minstrel import tries_of
from benchmarks.minstrel_vs_kernel import SelectedFrame
from sim_backends.emulated.linux_wifi.virtual_machine import ROOT_VARIABLE
from sim_backends.radio.rate_control import minstrel_ht
from tests.helpers.paths import ROOT

SEEDS = range(2)


@pytest.fixture(scope="module", params=study.TRACES)
def case(request: pytest.FixtureRequest) -> tuple[dict[str, Any], str]:
    """Return a trace, and the recording of the kernel with this trace."""
    name = str(request.param)
    text = kernel_recordings.load(study.recording(name))
    return study.trace(study.FRAMES, fading=study.TRACES[name]), text


def test_tries_in_a_recording_follow_from_the_trace_and_the_rate_chains(case: tuple[dict[str, Any], str]) -> None:
    trace, text = case
    frames = study.read(text)
    assert len(frames) == study.FRAMES
    for number, (_, stages, tries, is_received) in enumerate(frames):
        expected_tries, expected_success = tries_of(trace, number, stages)
        assert (sum(expected_tries), expected_success) == (tries, is_received)


def kernel_and_model_frames(
    case: tuple[dict[str, Any], str],
) -> tuple[list[SelectedFrame], list[list[SelectedFrame]]]:
    trace, text = case
    kernel = study.kernel_frames(text)
    return kernel, [study.fieldkit_frames(trace, [frame.time_ns for frame in kernel], seed) for seed in SEEDS]


def test_rates_and_goodput_are_close_to_those_of_the_kernel(case: tuple[dict[str, Any], str]) -> None:
    """Kernel and model draw different samples and differ more with fading. The bounds are for this trace."""
    kernel, runs = kernel_and_model_frames(case)
    for frames in runs:
        assert study.goodput_bit_s(frames) == pytest.approx(study.goodput_bit_s(kernel), rel=0.1)
        assert study.difference(study.frames_per_mcs(kernel), study.frames_per_mcs(frames)) < 0.2
        samples = [sum(frame.is_sample for frame in selected) for selected in (kernel, frames)]
        assert samples[1] == pytest.approx(samples[0], rel=0.1)
        assert correlation(study.rates_bit_s(kernel), study.rates_bit_s(frames)) > 0.9


def test_a_model_with_other_rules_is_detected(
    case: tuple[dict[str, Any], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(minstrel_ht, "_UPDATE_NS", 1_000_000_000)
    kernel, runs = kernel_and_model_frames(case)
    assert study.difference(study.frames_per_mcs(kernel), study.frames_per_mcs(runs[0])) > 0.2


def test_the_difference_of_distributions_is_a_share() -> None:
    assert study.difference(Counter(a=2, b=2), Counter(a=1, b=1)) == 0
    assert study.difference(Counter(a=3, b=1), Counter(a=1, c=3)) == pytest.approx(0.75)


@pytest.mark.emulated
@pytest.mark.nightly
def test_the_kernel_of_a_virtual_machine_is_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ROOT_VARIABLE, str(ROOT / ".linux"))
    trace = study.trace(100, fading=False)
    frames = study.read(study.record(trace))
    assert len(frames) == 100
    for number, (_, stages, tries, is_received) in enumerate(frames):
        expected_tries, expected_success = tries_of(trace, number, stages)
        assert (sum(expected_tries), expected_success) == (tries, is_received)
