"""Every output of fieldkit on the stored trials, as texts, to compare one version of the code with another.

Run as a program by the Python of the version to record: `python -P tests/helpers/stored_trials.py FOLDER` writes the
texts into FOLDER. It imports nothing of the tests, so any version can run it.
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

_DRAWN: Final = frozenset(("style", "script", "svg"))
"""Elements of the page whose text is no sentence: matplotlib's letters among them."""


@contextlib.contextmanager
def copied(folder: Path) -> Iterator[list[Path]]:
    """Copy the stored trials to `folder`/trials, work there, and yield their relative paths in order of time."""
    shutil.copytree(TRIALS, folder / "trials")
    with contextlib.chdir(folder):
        yield sorted(Path("trials").iterdir())


def texts(trials: Sequence[Path]) -> Iterator[tuple[str, str]]:
    """Yield the name and text of each output; the working folder is that of `copied`.

    `trials` is the lossless run, the lossy run, and others, as they are stored.
    """
    for form in ("csv", "json", "markdown", "latex"):
        yield f"aggregate.{form}", said("aggregate", "trials", "--format", form)
    lossless, lossy = (trial for trial in trials if "_los_" in trial.name)
    for form in ("csv", "json", "markdown"):
        yield f"compare.{form}", said("compare", str(lossless), str(lossy), "--force", "--format", form)
    said("export", "trials", "--format", "csv", "-o", "table.csv")
    yield "export.csv", Path("table.csv").read_text(encoding="utf-8")
    yield "mcap.json", _json({trial.name: _timeline(trial) for trial in trials})
    made: list[contents.Contents] = []
    put_together = contents.put_together

    def kept(*words: Any, **options: Any) -> contents.Contents:  # noqa: ANN401 (what it takes is its own affair)
        made.append(put_together(*words, **options))
        return made[-1]

    with patch.object(contents, "put_together", kept):
        said("report", "trials", "-o", "report.html")
    yield "report.txt", _words(Path("report.html").read_text(encoding="utf-8"))
    yield "figures.json", _json(list(_figures(made[0])))


def said(*words: str) -> str:
    """Return what a command prints.

    Raises:
        AssertionError: It failed.
    """
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        code = main(list(words))
    assert code == 0, f"{words} ended with {code}"
    return out.getvalue()


def _json(value: object) -> str:
    return json.dumps(value, indent=1, ensure_ascii=False) + "\n"


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def _timeline(trial: Path) -> dict[str, Any]:
    """Return per topic of a trial's MCAP file its schema, times, and a digest of all messages."""
    out = Path(f"{trial.name}.mcap")
    said("export", str(trial), "--format", "mcap", "-o", str(out))
    topics: dict[str, list[Any]] = {}
    about: dict[str, Any] = {}
    with out.open("rb") as file:
        reader = make_reader(file)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            about[channel.topic] = {
                "schema": [schema.name, schema.encoding, _digest(json.loads(schema.data))],
                "channel": [channel.message_encoding, dict(channel.metadata)],
            }
            stamps = message.log_time, message.publish_time
            topics.setdefault(channel.topic, []).append((*stamps, json.loads(message.data, parse_float=_float)))
        kept = {one.name: dict(one.metadata) for one in reader.iter_metadata()}
    found: dict[str, Any] = {
        topic: about[topic]
        | {"messages": len(each), "first_ns": each[0][0], "last_ns": each[-1][0], "sha256": _digest(each)}
        for topic, each in sorted(topics.items())
    }
    return {"metadata": kept, "topics": found}


def _float(text: str) -> float:
    """Return a number in 12 digits: numpy adds up in another order where a processor has wider vectors."""
    return float(f"{float(text):.12g}")


class _Page(HTMLParser):
    """Collects the texts and links of a page, a line each, and how long its bars are."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []
        self._inside = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        told = dict(attrs)
        if tag in _DRAWN:
            self._inside += 1
        self.lines.extend(
            f"[{name}] {told[name]}" for name in ("href", "aria-label", "title", "style") if told.get(name)
        )

    def handle_endtag(self, tag: str) -> None:
        if tag in _DRAWN:
            self._inside -= 1

    def handle_data(self, data: str) -> None:
        if not self._inside and data.strip():
            self.lines.append(" ".join(data.split()))


def _words(page: str) -> str:
    """Return what a reader reads on a page, without the version that made it."""
    parser = _Page()
    parser.feed(page)
    lines = [re.sub(r"(fieldkit) \d\S*", r"\1 VERSION", line) for line in parser.lines]
    return "\n".join(lines) + "\n"


def _figures(made: contents.Contents) -> Iterator[dict[str, Any]]:
    """Yield each chart of the report: its words, the number of values of each panel, and a digest of them."""
    for section in (*made.against_distance, *made.sections):
        for chart in section.charts:
            plain = _plain(chart)
            numbers = [one for one in _leaves(plain) if isinstance(one, float)]
            yield {
                "section": section.title,
                "words": [one for one in _leaves(plain) if isinstance(one, str)],
                "numbers": len(numbers),
                "sum": float(f"{sum(numbers):.9g}"),
                "sha256": _digest(plain),
            }


def _plain(value: Any) -> Any:  # noqa: ANN401 (whatever a chart is made of)
    """Return lists, texts and numbers: no field names, and 9 digits, so that neither naming nor a processor shows."""
    if dataclasses.is_dataclass(value):
        return [_plain(getattr(value, field.name)) for field in dataclasses.fields(value)]
    if isinstance(value, Mapping):
        return [[_plain(key), _plain(one)] for key, one in value.items()]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, int | float):
        return float(f"{value:.9g}")
    if isinstance(value, Path | Enum):
        return value.name
    return value if isinstance(value, str | None) else [_plain(one) for one in value]


def _leaves(value: Any) -> Iterator[str | float | None]:  # noqa: ANN401 (what `_plain` returns)
    if isinstance(value, list):
        for one in value:
            yield from _leaves(one)
    else:
        yield value


if __name__ == "__main__":
    target = Path(sys.argv[1]).resolve()
    target.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as place, copied(Path(place)) as found_trials:
        for file_name, text in texts(found_trials):
            (target / file_name).write_text(text, encoding="utf-8")
