"""In trials with faults, no repeat is lost or measured twice, and no attempt is void without a fault."""

import os
import subprocess
import sys
from collections.abc import Callable

import pytest

from tests.e2e.chaos import RECOVERY_NS, VOIDS_PER_FAULT, InjectedFault, VoidAttempt, unexplained
from tests.helpers.paths import ROOT

IN_CI = 3
"""Seed of the trial in CI."""
AT_NIGHT = (1, 2, 4, 5)
DEBIAN = {1, 2}
"""Seeds of trials with Debian's ROS, which takes a third of the processor time of all programs."""
FAULTS = 6
REPEATS = 5
"""Repeats per protocol; if a trial ends before the last fault, another trial gets the remaining faults."""
LIMIT_S = 900


@pytest.mark.emulated
def test_no_repeat_is_lost_in_a_trial_with_faults(record_property: Callable[[str, object], None]) -> None:
    (output,) = outputs(IN_CI)
    record_property("result", output)


@pytest.mark.emulated
@pytest.mark.nightly
def test_no_repeat_of_four_more_trials_is_lost(record_property: Callable[[str, object], None]) -> None:
    for output in outputs(*AT_NIGHT):
        record_property("result", output)


def outputs(*seeds: int) -> list[str]:
    """Run a trial per seed in parallel, because trials mostly wait; check the outputs and return them."""
    processes = [
        subprocess.Popen(
            (
                sys.executable,
                "-m",
                "tests.e2e.chaos",
                "--seed",
                str(seed),
                "--faults",
                str(FAULTS),
                "--repeats",
                str(REPEATS),
                *(() if seed in DEBIAN else ("--built-in-ros",)),
            ),
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )
        for seed in seeds
    ]
    texts = [process.communicate(timeout=LIMIT_S)[0] for process in processes]
    for process, text in zip(processes, texts, strict=True):
        assert process.returncode == 0, text
        assert f"faults injected: {FAULTS}, repeats lost: 0" in text
        assert f"{2 * REPEATS} repeats planned, {2 * REPEATS} valid" in text
    return [text.strip() for text in texts]


def void(started_ns: int, ended_ns: int) -> VoidAttempt:
    return VoidAttempt("tcp-01.void1", "why", started_ns, ended_ns)


FAULTS_AT = (InjectedFault("link cut", 100, 200), InjectedFault("fieldkit killed", RECOVERY_NS * 3, RECOVERY_NS * 3))


@pytest.mark.parametrize(
    "during", [void(0, 100), void(150, 160), void(200 + RECOVERY_NS, RECOVERY_NS * 2), void(0, RECOVERY_NS * 9)]
)
def test_a_fault_during_an_attempt_explains_its_void_result(during: VoidAttempt) -> None:
    assert unexplained([during], FAULTS_AT) == []


@pytest.mark.parametrize("attempt", [void(0, 99), void(201 + RECOVERY_NS, RECOVERY_NS * 2)])
def test_a_void_attempt_without_a_fault_is_unexplained(attempt: VoidAttempt) -> None:
    assert unexplained([attempt], FAULTS_AT) == [attempt]


def test_a_fault_does_not_explain_all_later_attempts() -> None:
    attempts = [void(0, 150 + number) for number in range(VOIDS_PER_FAULT + 3)]
    assert unexplained(attempts, FAULTS_AT) == attempts[VOIDS_PER_FAULT:]
    late = void(0, RECOVERY_NS * 4)
    assert unexplained([*attempts[:VOIDS_PER_FAULT], late], FAULTS_AT) == []
