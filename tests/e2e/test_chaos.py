"""Trials of 12 repeats among faults, each by another seed: none lost, measured twice or void without a cause."""

import os
import subprocess
import sys
from collections.abc import Callable

import pytest

from tests.e2e.chaos import AFTERMATH_NS, VOIDS_PER_FAULT, Befell, Void, unexplained
from tests.helpers.paths import ROOT

IN_CI = 3
"""The seed of the trial that CI runs."""
AT_NIGHT = (1, 2, 4, 5)
DEBIAN = {1, 2}
"""Seeds whose robots have Debian's ROS; it takes a third of the processor time of all that runs."""
FAULTS = 8
REPEATS = 6
"""Per protocol; should a trial end before the last fault, another one meets the rest."""
LIMIT_S = 900


@pytest.mark.emulated
def test_no_repeat_is_lost_whatever_befalls_a_trial(record_property: Callable[[str, object], None]) -> None:
    (said,) = outputs(IN_CI)
    record_property("said", said)


@pytest.mark.emulated
@pytest.mark.nightly
def test_no_repeat_of_four_more_trials_is_lost(record_property: Callable[[str, object], None]) -> None:
    for said in outputs(*AT_NIGHT):
        record_property("said", said)


def outputs(*seeds: int) -> list[str]:
    """Run a trial by each seed, at the same time, as they mostly wait; return what they print, after checking it."""
    running = [
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
    said = [process.communicate(timeout=LIMIT_S)[0] for process in running]
    for process, text in zip(running, said, strict=True):
        assert process.returncode == 0, text
        assert f"faults injected: {FAULTS}, repeats lost: 0" in text
        assert f"{2 * REPEATS} repeats planned, {2 * REPEATS} valid" in text
    return [text.strip() for text in said]


def void(began_ns: int, ended_ns: int) -> Void:
    return Void("tcp-01.void1", "why", began_ns, ended_ns)


FAULTS_AT = (Befell("link cut", 100, 200), Befell("fieldkit killed", AFTERMATH_NS * 3, AFTERMATH_NS * 3))


@pytest.mark.parametrize(
    "during", [void(0, 100), void(150, 160), void(200 + AFTERMATH_NS, AFTERMATH_NS * 2), void(0, AFTERMATH_NS * 9)]
)
def test_a_fault_during_an_attempt_explains_that_it_is_void(during: Void) -> None:
    assert unexplained([during], FAULTS_AT) == []


@pytest.mark.parametrize("beside", [void(0, 99), void(201 + AFTERMATH_NS, AFTERMATH_NS * 2)])
def test_an_attempt_without_a_fault_has_no_reason_to_be_void(beside: Void) -> None:
    assert unexplained([beside], FAULTS_AT) == [beside]


def test_a_fault_does_not_explain_every_attempt_that_follows() -> None:
    many = [void(0, 150 + number) for number in range(VOIDS_PER_FAULT + 3)]
    assert unexplained(many, FAULTS_AT) == many[VOIDS_PER_FAULT:]
    late = void(0, AFTERMATH_NS * 4)
    assert unexplained([*many[:VOIDS_PER_FAULT], late], FAULTS_AT) == []
