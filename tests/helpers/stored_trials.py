"""All outputs of fieldkit for the stored trials as texts, for comparisons between versions of fieldkit.

`python -P tests/helpers/stored_trials.py FOLDER` writes the texts to FOLDER. Run it with the Python in whose
environment the version to record is installed. It imports no test modules, so each version can run it.
"""

import contextlib
import dataclasses
import hashlib
import io
import json
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import numpy as np
from mcap.reader import make_reader

from fieldkit.cli import main
from fieldkit.report import contents

STORED: Final = Path(__file__).resolve().parents[1] / "data" / "fieldkit" / "4"
TRIALS: Final = STORED / "trials"
OUTPUTS: Final = STORED / "outputs"

_SKIPPED_ELEMENTS: Final = frozenset(("style", "script", "svg"))
"""Elements of the page without prose, such as the letters that matplotlib draws."""


@contextlib.contextmanager
def copy_trials(folder: Path) -> Iterator[list[Path]]:
    """Copy the stored trials to `folder`/trials, change to `folder`, and yield their relative paths by time."""
    shutil.copytree(TRIALS, folder / "trials")
    with contextlib.chdir(folder):
        yield sorted(Path("trials").iterdir())


def texts(trials: Sequence[Path]) -> Iterator[tuple[str, str]]:
    """Yield the name and text of each output; call it in the working folder that `copy_trials` sets.

    `trials` contains the lossless run, the lossy run, and others, in the order in which they are stored.
    """
    for form in ("csv", "json", "markdown", "latex"):
        yield f"aggregate.{form}", command_output("aggregate", "trials", "--format", form)
    lossless, lossy = (trial for trial in trials if "_los_" in trial.name)
    for form in ("csv", "json", "markdown"):
        yield f"compare.{form}", command_output("compare", str(lossless), str(lossy), "--force", "--format", form)
    command_output("export", "trials", "--format", "csv", "-o", "table.csv")
    yield "export.csv", Path("table.csv").read_text(encoding="utf-8")
    yield "mcap.json", _json({trial.name: _timeline(trial) for trial in trials})
    recorded: list[contents.Contents] = []
    build_contents = contents.build_contents

    def record_contents(*arguments: Any, **options: Any) -> contents.Contents:  # noqa: ANN401 (passed on unchanged)
        recorded.append(build_contents(*arguments, **options))
        return recorded[-1]

    with patch.object(contents, "build_contents", record_contents):
        command_output("report", "trials", "-o", "report.html")
    yield "report.txt", _page_text(Path("report.html").read_text(encoding="utf-8"))
    yield "figures.json", _json(list(_figures(recorded[0])))


def command_output(*arguments: str) -> str:
    """The output of a command.

    Raises:
        AssertionError: The command failed.
    """
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        code = main(list(arguments))
    assert code == 0, f"{arguments} exited with {code}"
    return output.getvalue()


def _json(value: object) -> str:
    return json.dumps(value, indent=1, ensure_ascii=False) + "\n"


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def _timeline(trial: Path) -> dict[str, Any]:
    """Schema, times, and a digest of all messages for each topic of a trial's MCAP file."""
    path = Path(f"{trial.name}.mcap")
    command_output("export", str(trial), "--format", "mcap", "-o", str(path))
    topics: dict[str, list[Any]] = {}
    descriptions: dict[str, Any] = {}
    with path.open("rb") as file:
        reader = make_reader(file)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            descriptions[channel.topic] = {
                "schema": [schema.name, schema.encoding, _digest(json.loads(schema.data))],
                "channel": [channel.message_encoding, dict(channel.metadata)],
            }
            times_ns = message.log_time, message.publish_time
            topics.setdefault(channel.topic, []).append((*times_ns, json.loads(message.data, parse_float=_float)))
        metadata = {record.name: dict(record.metadata) for record in reader.iter_metadata()}
    topic_summaries: dict[str, Any] = {
        topic: descriptions[topic]
        | {
            "messages": len(topic_messages),
            "first_ns": topic_messages[0][0],
            "last_ns": topic_messages[-1][0],
            "sha256": _digest(topic_messages),
        }
        for topic, topic_messages in sorted(topics.items())
    }
    return {"metadata": metadata, "topics": topic_summaries}


def _float(text: str) -> float:
    """A number with 12 digits, because numpy sums in a different order on processors with wider vectors."""
    return float(f"{float(text):.12g}")


class _Page(HTMLParser):
    """Collects the texts, links and bar lengths of a page as lines."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []
        self._skipped_depth = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = dict(attrs)
        if tag in _SKIPPED_ELEMENTS:
            self._skipped_depth += 1
        self.lines.extend(
            f"[{name}] {attributes[name]}"
            for name in ("href", "aria-label", "title", "style")
            if attributes.get(name)
        )

    def handle_endtag(self, tag: str) -> None:
        if tag in _SKIPPED_ELEMENTS:
            self._skipped_depth -= 1

    def handle_data(self, data: str) -> None:
        if not self._skipped_depth and data.strip():
            self.lines.append(" ".join(data.split()))


def _page_text(page: str) -> str:
    """The visible text of a page, without the version of fieldkit."""
    parser = _Page()
    parser.feed(page)
    lines = [re.sub(r"(fieldkit) \d\S*", r"\1 VERSION", line) for line in parser.lines]
    return "\n".join(lines) + "\n"


def _figures(report_contents: contents.Contents) -> Iterator[dict[str, Any]]:
    """Yield each chart of the report: its texts, the count and sum of its values, and a digest of the chart."""
    for section in (*report_contents.against_distance, *report_contents.sections):
        for chart in section.charts:
            plain = _plain(chart)
            numbers = [leaf for leaf in _leaves(plain) if isinstance(leaf, float)]
            yield {
                "section": section.title,
                "words": [leaf for leaf in _leaves(plain) if isinstance(leaf, str)],
                "numbers": len(numbers),
                "sum": float(f"{sum(numbers):.9g}"),
                "sha256": _digest(plain),
            }


def _plain(value: Any) -> Any:  # noqa: ANN401 (any part of a chart)
    """A value as lists, texts and numbers with 9 digits, so that field names and processors have no effect."""

    if dataclasses.is_dataclass(value):
        values = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        # The recorded outputs are older than heat maps, which stored trials do not have.
        return [_plain(item) for name, item in values.items() if (name, item) != ("heat", None)]
    if isinstance(value, Mapping):
        return [[_plain(key), _plain(item)] for key, item in value.items()]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, int | float):
        return float(f"{value:.9g}")
    if isinstance(value, Path | Enum):
        return value.name
    return value if isinstance(value, str | None) else [_plain(item) for item in value]


def _leaves(value: Any) -> Iterator[str | float | None]:  # noqa: ANN401 (a result of `_plain`)
    if isinstance(value, list):
        for item in value:
            yield from _leaves(item)
    else:
        yield value


if __name__ == "__main__":
    target = Path(sys.argv[1]).resolve()
    target.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as place, copy_trials(Path(place)) as copied_trials:
        for file_name, text in texts(copied_trials):
            (target / file_name).write_text(text, encoding="utf-8")
