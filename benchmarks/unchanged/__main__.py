"""Compare the behaviour of two commits; see CONTRIBUTING.md.

`python -m benchmarks.unchanged BASE [HEAD]` exits with 1 if the outputs differ in more than words. Differences in
words are called labels.
"""

import argparse
import dataclasses
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from benchmarks.unchanged import comparison, items, recorder, structure, suite, trees
from benchmarks.unchanged.items import Item, ItemKind
from benchmarks.unchanged.trees import Tree

_SHOWN: Final = 100
"""Differences that are printed with their lines; all are counted."""

TESTS, STRUCTURE = "tests", "structure"
PARTS: Final = (*(kind.name.lower() for kind in ItemKind), TESTS, STRUCTURE)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the comparison; return 0 if only labels differ, 1 if anything else differs, 2 for a wrong command line."""
    arguments = _arguments(argv)
    parts = [part for part in arguments.only or PARTS if part not in arguments.without]
    start_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="unchanged-") as temporary:
        folder = Path(temporary)
        try:
            base = trees.export(arguments.base, folder / "base")
            head = trees.export(arguments.head, folder / "head")
        except trees.UnknownCommitError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        print(f"base {base.commit[:12]}, head {head.commit[:12]}\n")
        same = True
        if kinds := [kind for kind in ItemKind if kind.name.lower() in parts]:
            same &= _behaviour(base, head, kinds, labels_shown=arguments.labels)
        if TESTS in parts:
            same &= _tests(base, head)
        if STRUCTURE in parts:
            print("\n" + structure.table(base, head))
    print(f"\n{'unchanged' if same else 'CHANGED'}, {time.monotonic() - start_s:.0f} s")
    return 0 if same else 1


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.unchanged", description=__doc__)
    parser.add_argument("base", help="the commit before the change")
    parser.add_argument(
        "head", nargs="?", default=trees.WORKING_TREE, help="the commit after the change (default: %(default)s)"
    )
    parser.add_argument(
        "--only", action="append", choices=PARTS, help="compare only this class; may be given more than once"
    )
    parser.add_argument("--without", action="append", default=[], choices=PARTS, help="do not compare this")
    parser.add_argument("--labels", type=int, default=40, metavar="N", help="labels that are listed (default: 40)")
    return parser.parse_args(argv)


def _behaviour(base: Tree, head: Tree, kinds: Sequence[ItemKind], *, labels_shown: int) -> bool:
    """Record the items with both trees at the same time, and print a line for each class."""
    for tree in (base, head):
        items.prepare(tree)
    selected_items = items.items(base, kinds)
    recordings = [_start(tree, selected_items) for tree in (base, head)]
    for recording in recordings:
        if recording.wait() != 0:
            raise RuntimeError("a recorder ended early; its error is above")
    labels: Counter[tuple[str, str]] = Counter()
    real: list[str] = []
    for kind in kinds:
        counts: Counter[str] = Counter()
        for number, item in enumerate(selected_items):
            if item.kind is not kind:
                continue
            differences = comparison.compare(item, number, base, head)
            labels += differences.labels
            real += [f"{kind}: {item}\n  {text}".replace("\n", "\n  ") for text in differences.real]
            counts["different" if differences.real else "labels" if differences.labels else "same"] += 1
            counts["succeeded"] += (base.results / str(number) / "exit_code").read_text(encoding="ascii") == "0\n"
        print(
            f"{kind + ':':40} {counts['same']:5} the same, {counts['labels']:4} with other labels,"
            f" {counts['different']:4} different; exit code 0: {counts['succeeded']}"
        )
    _print_details(labels, real, labels_shown)
    return not real


def _start(tree: Tree, selected_items: Sequence[Item]) -> "subprocess.Popen[bytes]":
    listed = [
        dataclasses.asdict(item) | {"working_folder": str(tree.lab / item.working_folder)} for item in selected_items
    ]
    path = tree.folder / "items.json"
    path.write_text(json.dumps(listed), encoding="utf-8")
    command = (*trees.python(), str(Path(recorder.__file__)), str(path), str(tree.results))
    return subprocess.Popen(command, env=tree.environment(), cwd=tree.folder)


def _print_details(labels: Counter[tuple[str, str]], real: Sequence[str], labels_shown: int) -> None:
    if labels:
        print(f"\n{len(labels)} labels differ:")
        for (old, new), count in labels.most_common(labels_shown):
            print(f"  {count:4} x  {old or '(nothing)'}  ->  {new or '(nothing)'}")
        if len(labels) > labels_shown:
            print(f"  ... and {len(labels) - labels_shown} more: --labels {len(labels)}")
    for text in real[:_SHOWN]:
        print(f"\nDIFFERENT {text}")
    if len(real) > _SHOWN:
        print(f"\n... and {len(real) - _SHOWN} more differences")


def _tests(base: Tree, head: Tree) -> bool:
    changes = suite.compare(base.code / "tests", head.code / "tests")
    print(f"\n{changes.summary()}")
    for line in changes.lines():
        print(f"  {line}")
    return not changes.has_differences


if __name__ == "__main__":
    sys.exit(main())
