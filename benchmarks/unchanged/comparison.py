"""Compare two recorded outputs: they can be equal, differ only in words, or differ in other parts.

Machine-readable output (commands of dry runs, tables, exports, hashes, exit codes) must be equal, except for parts
that vary between runs, such as time stamps, and for sentences in printed JSON. Other text (help, messages, tables on
a terminal, reports) may differ in words, which are listed as labels; its numbers and options must be equal and in the
same order.
"""

import difflib
import json
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from benchmarks.unchanged.items import Item, ItemKind
from benchmarks.unchanged.trees import Tree

_VARYING: Final = (
    (re.compile(r"\d{8}T\d{6}\.\d{6}Z"), "STAMP"),
    (re.compile(r'"utc_ns": \d+'), '"utc_ns": 0'),
    (re.compile(r'"free_bytes": \d+'), '"free_bytes": 0'),
    # The name of a program on robots has the hash of its text, comments included.
    (re.compile(r"(job|agent|fieldkit)-[0-9a-f]{12}\b"), r"\1-HASH"),
)
_FIXED: Final = re.compile(r"--[a-z][a-z-]+|\d+(?:\.\d+)?")
"""Parts of other text that must not change: options and numbers."""

_WORDS_IN_EVENTS: Final = frozenset(
    ("text", "how", "note", "detail", "remedy", "reason", "summary", "question", "why")
)
"""Fields of JSON events that are sentences."""

_MASKED_IN_TRIALS: Final = re.compile(r"\d+(?:\.\d+)?")
_TEXTS: Final = frozenset((".html", ".md", ".txt", ""))
_SHOWN_LINES: Final = 12


@dataclass
class Differences:
    """Differences between two outputs.

    Attributes:
        labels: Pairs of passages, before and after the change, with their counts.
        real: Descriptions of differences that are not labels, with the lines or files that differ.
    """

    labels: Counter[tuple[str, str]] = field(default_factory=Counter)
    real: list[str] = field(default_factory=list)

    def add(self, other: "Differences") -> None:
        """Add the differences of another output."""
        self.labels += other.labels
        self.real += other.real


def compare(item: Item, number: int, base: Tree, head: Tree) -> Differences:
    """Compare the outputs of a command that was run with the source tree before a change and with the one after it.

    Args:
        item: The command, and what its output is.
        number: Its place in the list of items.
        base: The tree before, with recorded results.
        head: The tree after, with recorded results.
    """
    differences = Differences()
    before, after = (tree.results / str(number) for tree in (base, head))
    code = (before / "exit_code").read_text(encoding="ascii").strip()
    if item.succeeds and code != "0":
        error = (before / "stderr").read_text(encoding="utf-8", errors="replace").strip()
        differences.real.append(
            f"it failed before the change (exit code {code}), so nothing can be compared\n{error}"
        )
    names = [{str(path.relative_to(top)) for path in top.rglob("*") if path.is_file()} for top in (before, after)]
    if item.kind is ItemKind.TRIALS:
        differences.add(_compare_trials(before, after))
        return differences
    if names[0] != names[1]:
        differences.real.append(
            f"files: {sorted(names[0] - names[1])} only before, {sorted(names[1] - names[0])} only after"
        )
    for name in sorted(names[0] & names[1]):
        contents = [(top / name).read_bytes() for top in (before, after)]
        texts = [_without_variable_parts(content, tree) for content, tree in zip(contents, (base, head), strict=True)]
        if contents[0] == contents[1] or (None not in texts and texts[0] == texts[1]):
            continue
        if texts[0] is None or texts[1] is None:
            differences.real.append(f"{name}: other bytes")
        else:
            differences.add(_compare_texts(name, texts[0], texts[1], exact=_must_be_equal(item, name)))
    return differences


def _without_variable_parts(content: bytes, tree: Tree) -> str | None:
    """Return a text without parts that vary between runs, or None if the content is not text."""
    try:
        text = content.decode()
    except UnicodeDecodeError:
        return None
    text = text.replace(str(tree.folder), "FOLDER")
    for pattern, replacement in _VARYING:
        text = pattern.sub(replacement, text)
    return text


def _must_be_equal(item: Item, name: str) -> bool:
    if name == "exit_code" or item.simulation is not None:
        return True
    if name == "stdout":
        return "csv" in item.arguments
    return name != "stderr" and Path(name).suffix not in _TEXTS | {".svg"} and "junit" not in item.arguments


def _compare_texts(name: str, before: str, after: str, *, exact: bool) -> Differences:
    if not exact and (pairs := _json_lines(before, after)) is not None:
        differences = Differences()
        for old, new in pairs:
            differences.add(_compare_values(name, old, new))
        return differences
    if exact or _FIXED.findall(before) != _FIXED.findall(after):
        return Differences(real=[f"{name}:\n{_diff(before, after)}"])
    return Differences(labels=Counter(labels(before, after)))


def _json_lines(before: str, after: str) -> list[tuple[Any, Any]] | None:
    """Return pairs of the JSON values of two texts, per line or of the whole text.

    The result is None if a text is not JSON, or if the numbers of values differ.
    """
    values = [_json_values(text) for text in (before, after)]
    if values[0] is None or values[1] is None or len(values[0]) != len(values[1]):
        return None
    return list(zip(values[0], values[1], strict=True))


def _json_values(text: str) -> list[Any] | None:
    try:
        return [json.loads(text)]
    except ValueError:
        pass
    try:
        return [json.loads(line) for line in text.splitlines()]
    except ValueError:
        return None


def _compare_values(where: str, old: Any, new: Any) -> Differences:  # noqa: ANN401 (any JSON value)
    """Compare two JSON values: sentences may differ in words, everything else must be equal."""
    if old == new:
        return Differences()
    differences = Differences()
    if isinstance(old, dict) and isinstance(new, dict) and list(old) == list(new):
        for key in old:
            if key in _WORDS_IN_EVENTS and isinstance(old[key], str) and isinstance(new[key], str):
                if old[key] != new[key]:
                    differences.add(_compare_texts(f"{where}, {key}", old[key], new[key], exact=False))
            else:
                differences.add(_compare_values(f"{where}, {key}", old[key], new[key]))
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for old_item, new_item in zip(old, new, strict=True):
            differences.add(_compare_values(where, old_item, new_item))
    else:
        differences.real.append(f"{where}:\n- {_shortened(old)}\n+ {_shortened(new)}")
    return differences


def _shortened(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 300 else f"{text[:300]}..."


def _compare_trials(before: Path, after: Path) -> Differences:
    """Compare two runs of an emulated trial, whose numbers differ: events, their fields, files, and CSV headers."""
    differences = Differences()
    for name, shapes in {"exit code": _exit_codes, "events": _event_shapes, "files": _file_shapes}.items():
        old, new = ("\n".join(sorted(shapes(top))) for top in (before, after))
        if old != new:
            differences.real.append(f"{name}:\n{_diff(old, new)}")
    return differences


def _exit_codes(result: Path) -> Iterator[str]:
    yield (result / "exit_code").read_text(encoding="ascii")


def _event_shapes(result: Path) -> Iterator[str]:
    """Yield each event with its fields: the types of sentences and numbers, and the other values without digits."""
    for line in (result / "stdout").read_text(encoding="utf-8").splitlines():
        event = json.loads(line)
        shown = {
            key: type(value).__name__
            if key in _WORDS_IN_EVENTS or isinstance(value, int | float) or value is None
            else _MASKED_IN_TRIALS.sub("N", str(value))
            for key, value in event.items()
        }
        # A remaining time can be a float, an integer or unknown.
        yield json.dumps(
            {key: "number" if shown[key] in {"int", "float", "NoneType"} else shown[key] for key in shown}
        )


def _file_shapes(result: Path) -> Iterator[str]:
    """Yield each file of the trial, numbers masked, with the header if it is `trial.csv` or `summary.csv`."""
    folder = result / "trials"
    for path in folder.rglob("*"):
        if path.is_file():
            name = _MASKED_IN_TRIALS.sub("N", str(path.relative_to(folder)))
            header = path.read_text(encoding="utf-8").partition("\n")[0] if path.suffix == ".csv" else ""
            yield f"{name} {header if path.name in {'trial.csv', 'summary.csv'} else ''}".strip()


def labels(before: str, after: str) -> Iterator[tuple[str, str]]:
    """Yield the passages that differ between two texts, as words before and after."""
    old_lines, new_lines = before.splitlines(), after.splitlines()
    for tag, i1, i2, j1, j2 in difflib.SequenceMatcher(None, old_lines, new_lines, autojunk=False).get_opcodes():
        if tag == "equal":
            continue
        old, new = (" ".join(" ".join(lines).split()).split(" ") for lines in (old_lines[i1:i2], new_lines[j1:j2]))
        start = 0
        while start < min(len(old), len(new)) and old[start] == new[start]:
            start += 1
        end = 0
        while end < min(len(old), len(new)) - start and old[-1 - end] == new[-1 - end]:
            end += 1
        pair = " ".join(old[start : len(old) - end]), " ".join(new[start : len(new) - end])
        if pair[0] != pair[1]:
            yield pair


def _diff(before: str, after: str) -> str:
    lines = list(difflib.unified_diff(before.splitlines(), after.splitlines(), n=0, lineterm=""))[2:]
    shown = [line[:300] for line in lines if not line.startswith("@@")]
    more = [f"... and {len(shown) - _SHOWN_LINES} more lines"] if len(shown) > _SHOWN_LINES else []
    return "\n".join(shown[:_SHOWN_LINES] + more)
