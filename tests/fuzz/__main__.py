"""Hunt for inputs that break a reader: `python -m tests.fuzz --minutes 60`; again with one: `--replay FILE`."""

import argparse
import sys
import time
from pathlib import Path

from tests.fuzz import harness, targets
from tests.helpers.paths import ROOT


def main(argv: list[str]) -> int:
    """Hunt, or try again what a hunt has kept; return 1 where something broke."""
    if argv[:1] == ["work"]:
        names, seed, at, stop, folder = argv[1:]
        harness.work(targets.named(names), int(seed), range(int(at), int(stop)), Path(folder))
        return 0
    if argv[:1] == ["again"]:
        kept, place = map(Path, argv[1:])
        (target,) = targets.named(kept.name.partition(".")[0])
        print(harness.tried(target, kept.read_bytes(), place / "place") or "")
        return 0
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--inputs", type=int, default=1 << 60)
    parser.add_argument("--seed", type=int, default=int(time.time()), help="makes the inputs; each run's is another")
    parser.add_argument("--targets", default="", help=f"some of {','.join(targets.NAMES)}")
    parser.add_argument("--keep", type=Path, default=ROOT / "tests" / "fuzz" / "kept", help="gets inputs that broke")
    parser.add_argument("--replay", type=Path, help="an input that was kept")
    options = parser.parse_args(argv)
    if options.replay is not None:
        what = harness.replayed(options.replay)
        print(what or "nothing broke")
        return int(what is not None)
    return _hunt(options)


def _hunt(options: argparse.Namespace) -> int:
    began_s, defects, seen = time.monotonic(), 0, set[str]()
    ends_s = began_s + 60 * options.minutes
    options.keep.mkdir(exist_ok=True)
    print(f"seed {options.seed}", flush=True)
    for found in harness.hunted(options.targets, options.seed, options.inputs, options.keep, ends_s):
        if isinstance(found, int):
            print(f"{found} inputs, {(time.monotonic() - began_s) / 60:.1f} minutes, {defects} defects")
        elif (which := f"{found.target}: {found.what.partition(': ')[0]}") in seen:
            found.input.unlink()  # one of each says it
        else:
            seen.add(which)
            defects += 1
            print(f"{found.target}: {found.what}\n  {found.input}", flush=True)
    return int(defects > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
