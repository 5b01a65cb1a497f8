"""Comparability of two runs: what makes their numbers differ, other than what is being compared."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.analysis.parsing import Numbers
from fieldkit.analysis.quantities import DEFAULT_BY
from fieldkit.analysis.repeats import Key, Repeats
from fieldkit.core.columns import cell, plain_name

UNKNOWN: Final = "unknown"

SAME: Final = (
    "profiles_sha256",
    "procedure_sha256",
    "scenario",
    "topology",
    "distance_m",
    "protocol",
    "rtt_payload_bytes",
    "paper_window_bytes",
    "tcp_congestion_control",
)
"""Columns that must hold the same values on both sides."""

VARIED: Final = frozenset({"distance_m"})
"""Of these what may be all that differs: another protocol or topology brings other differences with it."""

_IDENTITY: Final = frozenset({"profiles_sha256", "procedure_sha256"})

SIZE_TOLERANCE: Final = 0.05
"""How far apart the median sizes of what was sent may be, as a share of the smaller."""

_MIXED: Final = (
    (
        "code_sha256",
        "schema_version",
        "Several versions of fieldkit ran these trials: without rebuilding, each measured its own.",
    ),
    ("profiles_sha256", "topology", "The robots or their profiles are not the same in all trials of a topology."),
    ("procedure_sha256", "procedure", "A procedure is not the same in all its trials."),
)
"""A column, within what it ought to be one, and what to say where it is not."""

_PAYLOAD: Final = "rtt_payload_bytes"

MIXED_BY: Final = frozenset((*(name for column, within, _ in _MIXED for name in (column, within)), _PAYLOAD))
"""Columns that `mixtures` looks at, beside those that tell conditions."""

_MESSAGES: Final = 2
"""How many messages more or less are no other size: a recorder subscribes and ends between two of them."""

DATAGRAM_FACTOR: Final = 1.5
"""How far apart the sizes of datagrams may be: the netcats send 8,192 or 16,384 bytes, and a file's last one less."""


@dataclass(frozen=True)
class Concern:
    """Something in which two runs differ, or may.

    Attributes:
        what: The column, or what was made of columns.
        a: What A has, for people; `unknown` where its rows do not say.
        b: What B has.
        cells: Where, in words; empty for all.
        refuses: Whether numbers so measured are not comparable; else it is worth knowing.
    """

    what: str
    a: str
    b: str
    cells: tuple[str, ...]
    refuses: bool

    def __str__(self) -> str:
        text = f"{self.what}: A has {self.a}, B has {self.b}"
        if not self.cells:
            return text
        more = f" and {len(self.cells) - 1} more" if len(self.cells) > 1 else ""
        return f"{text} ({self.cells[0]}{more})"


def concerns(pairs: Iterable[tuple[str, Repeats, Repeats]], by: Collection[str] = ()) -> tuple[Concern, ...]:
    """Return what speaks against comparing, refusals first.

    One of `VARIED` that is not in `by` is what is compared where either run has one value of it: no refusal.

    Args:
        pairs: Of each condition its name in words and the valid repeats of A and of B, at least one each.
        by: Columns that tell one condition from another.
    """
    found: dict[Concern, list[str]] = {}
    for name, a, b in pairs:
        for concern in _of_pair(a, b, VARIED - set(by)):
            found.setdefault(concern, []).append(name)
    merged = (Concern(one.what, one.a, one.b, tuple(names), one.refuses) for one, names in found.items())
    return tuple(sorted(merged, key=lambda one: not one.refuses))


def mixtures(repeats: Repeats, by: Sequence[str] = DEFAULT_BY) -> Iterator[str]:
    """Yield in a sentence each what was not the same in all of one run, though its names are.

    Args:
        repeats: All attempts of the run.
        by: Columns that tell one condition from another.
    """
    for name, within, what in _MIXED:
        if len(set(repeats.keys((within, name)))) > len(set(repeats.column(within))):
            yield what
    for name in (one for one in repeats.numbers if plain_name(one) == _PAYLOAD):
        pinged = repeats.where(np.isfinite(repeats.numbers[name]))
        if len(set(pinged.keys((*by, name)))) > len(set(pinged.keys(by))):
            yield "Echo requests of several sizes are in one condition: their round trips do not compare."
            return


def doubts(a: Repeats, b: Repeats) -> Iterator[Concern]:
    """Yield what is worth knowing of all repeats: two versions of fieldkit measured, or attempts are in both runs."""
    yield from _unlike("code_sha256", a, b, refuses=False)
    if same := len(_attempts(a) & _attempts(b)):
        yield Concern("attempts that the other has too", str(same), str(same), (), refuses=False)


def _attempts(rows: Repeats) -> set[Key]:
    return {key for key in rows.keys(("trial", "protocol", "repeat", "attempt")) if key[0]}


def _of_pair(a: Repeats, b: Repeats, varied: Collection[str]) -> Iterator[Concern]:
    for name in SAME:
        is_varied = name in varied and all(len(set(rows.column(name))) == 1 for rows in (a, b))
        yield from _unlike(name, a, b, refuses=not is_varied)
    yield from _files(a, b)
    yield from _datagrams(a, b)
    yield from _offload(a, b)


def _unlike(name: str, a: Repeats, b: Repeats, *, refuses: bool) -> Iterator[Concern]:
    of_a, of_b = _values(name, a), _values(name, b)
    unknown = UNKNOWN in {of_a, of_b}
    # What neither side measured cannot tell them apart; that neither says what it is can.
    if of_a != of_b or (unknown and name in _IDENTITY):
        yield Concern(name, of_a, of_b, (), refuses and (not unknown or name in _IDENTITY))


def _values(name: str, rows: Repeats) -> str:
    found = set(rows.column(name)) - {"", None}
    return ", ".join(sorted(map(cell, found))) or UNKNOWN


def _files(a: Repeats, b: Repeats) -> Iterator[Concern]:
    of_a, of_b = (_median(rows.numbers["sent_bytes"]) for rows in (a, b))
    one_a, one_b = (_bytes_per("bag_messages", rows) for rows in (a, b))
    room = np.fmax(SIZE_TOLERANCE * min(of_a, of_b), _MESSAGES * np.fmax(one_a, one_b))
    yield from _apart("sent_bytes, median", of_a, of_b, room)


def _datagrams(a: Repeats, b: Repeats) -> Iterator[Concern]:
    of_a, of_b = (_bytes_per("datagrams_sent", rows) for rows in (a, b))
    yield from _apart("bytes per datagram", of_a, of_b, (DATAGRAM_FACTOR - 1) * min(of_a, of_b))


def _bytes_per(name: str, rows: Repeats) -> float:
    """Return the median of the bytes sent for each of a count; NaN where none was counted."""
    counted = rows.numbers[name]
    return _median(rows.numbers["sent_bytes"] / np.where(counted > 0, counted, np.nan))


def _apart(what: str, of_a: float, of_b: float, room: float) -> Iterator[Concern]:
    """Yield two sizes in bytes, NaN where unknown, if they are more than `room` apart or one is unknown."""
    known = int(np.isfinite([of_a, of_b]).sum())
    if known == 1 or abs(of_a - of_b) > room:
        yield Concern(what, _bytes(of_a), _bytes(of_b), (), refuses=known == 2)


def _bytes(size: float) -> str:
    return f"{size:,.0f} B" if np.isfinite(size) else UNKNOWN


def _median(values: Numbers) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan


def _offload(a: Repeats, b: Repeats) -> Iterator[Concern]:
    of_a, of_b = (_superframes(rows) for rows in (a, b))
    if of_a != of_b:
        yield Concern("segmentation offload", of_a, of_b, (), refuses=UNKNOWN not in {of_a, of_b})


def _superframes(rows: Repeats) -> str:
    """Return whether captures show frames that only offload makes: on if it was in any repeat."""
    frames = rows.numbers["tcp_superframes"]
    known = frames[np.isfinite(frames)]
    if not len(known):
        return UNKNOWN
    return "on" if (known > 0).any() else "off"
