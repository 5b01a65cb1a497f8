"""Readers of what radios and programs say during a repeat, and of the paths and expressions that look into it."""

import gzip
import json
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final

from fieldkit.core.columns import cell
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import LinkSample, Role
from fieldkit.measure.evidence import link, link_samples, program_output
from tests.fuzz.harness import Target
from tests.helpers.paths import DATA

_IW: Final = DATA / "iw"
_CLOCK: Final = "==> clock <==\n100.00 1700000100.000000000 100.00\n==> iw station dump <==\n"
_OWN: Final = "".join(
    f"==> 101.{at:02d} {name} <==\n{path.read_text(encoding='utf-8')}"
    for name, pattern in (("link", "link-*"), ("survey", "survey-*"), ("station", "station*"), ("wireless", "wire*"))
    for at, path in enumerate(sorted(_IW.glob(f"{pattern}.txt")))
)
_WIRELESS: Final = "0000   54.  -56.  -256        0      0      0      0      0        0"
_PATHS: Final = (
    *(b"[0].a[1].b", b"end.sum.bits_per_second", b"*.*[] | [0]"),
    b"max_by(intervals, &sum.seconds).sum.bytes",
)
_EXPRESSIONS: Final = (b"rtt = ([0-9.]+) ms", b"^(\\S+) +dB$", b"(?i)(?:loss|lost)[: ]+([0-9]{1,3})%", b"(a+)+$")
_PRINTED: Final = {"end": {"sum": {"bits_per_second": 5e6}}, "intervals": [{"sum": {"seconds": 1, "bytes": 12}}]}


def _measured(samples: list[LinkSample]) -> None:
    """Measure a link; a table can hold what came of it."""
    found = link.measure(Role.SENDER, samples)
    link.link_history(samples)
    for column in link.COLUMNS:
        assert column.invalid_value_reason(cell(found.values.get(column.name))) is None, column.name


def _testbeds(data: bytes, place: Path) -> None:
    (place / link_samples.FILE).write_bytes(data)
    for samples in link_samples.read(place / link_samples.FILE).values():
        _measured(list(samples))


def _own(name: str, data: bytes, place: Path) -> None:
    """Read a robot's own samples, of which one file is the input and the others are whole."""
    (place / "sender-before.txt").write_text(_CLOCK, encoding="utf-8")
    if "link" not in name:
        (place / "sender-link.txt").write_text(_OWN, encoding="utf-8")
    (place / name).write_bytes(data)
    _measured(list(link_samples.read_robot(place, Role.SENDER)))


def _iw(data: bytes, _: Path) -> None:
    text = data.decode(errors="replace")
    link_samples.parse_stations(text)
    link_samples.parse_cell(text)
    link_samples.parse_channel(text)
    for line in text.split("\n"):
        link_samples.parse_wireless(line)


def _path(data: bytes, place: Path) -> None:
    """Look where a procedure's author says, a text of any length."""
    where = data.decode(errors="replace")
    (place / "run.txt").write_text(json.dumps(_PRINTED), encoding="ascii")
    if program_output.path_error(where) is None:
        with suppress(EvidenceError):
            program_output.at_path(place / "run.txt", where)


def _expression(data: bytes, place: Path) -> None:
    expression = data.decode(errors="replace")
    (place / "run.txt").write_text("rtt = 12.5 ms\nloss: 3%\n" + "a" * 5000 + "b\n", encoding="ascii")
    if program_output.expression_error(expression) is None:
        program_output.by_expression(place / "run.txt", expression)


def radio_targets() -> Iterator[Target]:
    """Yield the targets."""
    samples = link_samples.parse(_OWN)
    testbeds = link_samples.text({Role.SENDER: samples, Role.RECEIVER: samples[:3]}).encode()
    yield Target("link-csv", (testbeds,), _testbeds)
    states = (_CLOCK + (_IW / "station-iwlwifi-6.txt").read_text(encoding="utf-8")).encode()
    for name, seed in (
        ("sender-link.txt", _OWN.encode()),
        ("sender-link.txt.gz", gzip.compress(_OWN.encode(), mtime=0)),
        ("sender-before.txt", states),
    ):
        yield Target(f"own-{name}".replace(".", "_"), (seed,), partial(_own, name))
    said = (*sorted(path.read_bytes() for path in _IW.glob("*.txt")), _WIRELESS.encode())
    yield Target("telemetry", said, _iw)
    yield Target("json-path", _PATHS, _path)
    yield Target("expression", _EXPRESSIONS, _expression)
