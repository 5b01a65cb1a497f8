"""Five trials of 20 repeats among faults, each by another seed: nothing is lost, nothing is measured twice."""

import os
import subprocess
import sys
from collections.abc import Callable

import pytest

from tests.helpers.paths import ROOT

pytestmark = pytest.mark.emulated

SEEDS = (1, 2, 3, 4, 5)
FAULTS = 8
LIMIT_S = 900


def test_no_repeat_is_lost_whatever_befalls_a_trial(record_property: Callable[[str, object], None]) -> None:
    """All at once: they spend their time waiting."""
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
                "10",
            ),
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )
        for seed in SEEDS
    ]
    said = [process.communicate(timeout=LIMIT_S)[0] for process in running]
    for process, text in zip(running, said, strict=True):
        assert process.returncode == 0, text
        assert f"faults injected: {FAULTS}, repeats lost: 0" in text
        assert "20 repeats planned, 20 valid" in text
        record_property("said", text.strip())
