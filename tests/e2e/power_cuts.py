"""Repeated power cuts at random times on several file systems, a part of `make soak`.

tests/trial/test_power_cuts.py cuts the power at every sync, and a few times at random.
"""

import argparse
import random
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Final

from tests.helpers.cut_trials import calls_of_a_trial, lose_power_repeatedly, robots_with_much_evidence
from tests.helpers.disks import FILE_SYSTEMS, mount_workspace
from tests.helpers.host import separate_namespaces

MAX_CUTS_PER_TRIAL: Final = 6


def main() -> int:
    """Cut the power a number of times, and print the count per file system; a loss raises AssertionError."""
    parser = argparse.ArgumentParser(description="power cuts")
    parser.add_argument("--cuts", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    generator, cuts = random.Random(arguments.seed), Counter[str]()
    with (
        tempfile.TemporaryDirectory(prefix="fieldkit-power-") as folder,
        separate_namespaces(),
        mount_workspace(Path(folder)) as place,
        robots_with_much_evidence(),
    ):
        print(f"cutting in {folder}", flush=True)
        calls = calls_of_a_trial(place)
        while cuts.total() < arguments.cuts:
            for file_system in FILE_SYSTEMS:
                cuts[file_system.name] += lose_power_repeatedly(
                    file_system, place, generator, calls=calls, most=MAX_CUTS_PER_TRIAL
                )
    kinds = ", ".join(f"{count} on {name}" for name, count in sorted(cuts.items()))
    print(f"power cuts: {cuts.total()} ({kinds}); lost: 0")
    return 0


if __name__ == "__main__":
    sys.exit(main())
