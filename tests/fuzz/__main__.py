"""Search for inputs that break a reader: `python -m tests.fuzz --minutes 60`. `--replay FILE` repeats an input."""

import argparse
import json
import sys
import time
from pathlib import Path

from tests.fuzz import harness, targets
from tests.helpers.paths import ROOT


def main(argv: list[str]) -> int:
    """Run a search, or repeat an input of an earlier search; return 1 if a reader has a defect."""
    if argv[:1] == ["work"]:
        names, seed, start, stop, work_folder = argv[1:]
        harness.work(targets.select_targets(names), int(seed), range(int(start), int(stop)), Path(work_folder))
        return 0
    if argv[:1] == ["again"]:
        folder, *input_files = map(Path, argv[1:])
        for input_file in input_files:
            (target,) = targets.select_targets(input_file.name.partition(".")[0])
            failure = harness.try_input(target, input_file.read_bytes(), folder / "place")
            print(json.dumps(failure), flush=True)
        return 0
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--inputs", type=int, default=1 << 60)
    parser.add_argument(
        "--seed", type=int, default=int(time.time()), help="seed of the inputs; different for each run by default"
    )
    parser.add_argument("--targets", default="", help=f"targets, separated by commas, of {','.join(targets.NAMES)}")
    parser.add_argument(
        "--keep", type=Path, default=ROOT / "tests" / "fuzz" / "kept", help="folder for inputs that break a reader"
    )
    parser.add_argument("--replay", type=Path, help="repeat a kept input")
    options = parser.parse_args(argv)
    if options.replay is not None:
        (failure,) = harness.replay([options.replay])
        print(failure or "no defect")
        return int(failure is not None)
    return _search(options)


def _search(options: argparse.Namespace) -> int:
    start_s, defects, reported_keys = time.monotonic(), 0, set[str]()
    end_s = start_s + 60 * options.minutes
    options.keep.mkdir(exist_ok=True)
    print(f"seed {options.seed}", flush=True)
    for result in harness.search(options.targets, options.seed, options.inputs, options.keep, end_s):
        if isinstance(result, int):
            print(f"{result} inputs, {(time.monotonic() - start_s) / 60:.1f} minutes, {defects} defects")
        elif (defect_key := f"{result.target}: {result.failure.partition(': ')[0]}") in reported_keys:
            result.input.unlink()  # one input per defect is enough
        else:
            reported_keys.add(defect_key)
            defects += 1
            print(f"{result.target}: {result.failure}\n  {result.input}", flush=True)
    return int(defects > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
