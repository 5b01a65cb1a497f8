"""Whether two runs (sets of trials) can be compared: differences that make their numbers incomparable."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.analysis.parsing import Numbers
from fieldkit.analysis.quantities import DEFAULT_BY
from fieldkit.analysis.repeats import Key, Repeats
from fieldkit.core.columns import cell_text, plain_name

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
"""Columns that must have the same values in both runs, except as `concerns` and `_KERNEL_COLUMNS` describe."""

VARIED: Final = frozenset({"distance_m"})
"""Columns of `SAME` that may be the variable of a comparison. Protocol and topology are excluded, because they change
too many conditions.
"""

_KERNEL_COLUMNS: Final = frozenset({"tcp_congestion_control"})
"""Columns that depend on the operating system's kernel. They may differ in a comparison of backends, which use the
kernels of real robots, the kernel of the laptop that emulates robots, or the TCP of a simulation."""

_IDENTITY_COLUMNS: Final = frozenset({"profiles_sha256", "procedure_sha256"})

SIZE_TOLERANCE: Final = 0.05
"""Maximum difference of the median sent sizes, as a share of the smaller size."""

_MIXTURES: Final = (
    (
        "code_sha256",
        "schema_version",
        "Different versions of fieldkit measured these trials; fieldkit rebuild measures them with the same version.",
    ),
    ("profiles_sha256", "topology", "The robots or their profiles differ between trials of the same topology."),
    ("procedure_sha256", "procedure", "A procedure differs between its trials."),
)
"""Column, grouping column, and message if a group has several values of the column."""

_PAYLOAD: Final = "rtt_payload_bytes"

MIXTURE_COLUMNS: Final = frozenset(
    (*(name for column, grouping, _ in _MIXTURES for name in (column, grouping)), _PAYLOAD)
)
"""Columns that `mixtures` needs, in addition to the columns that identify conditions."""

MARKS: Final = "marks"
"""Column with the marks of a repeat: conditions that can explain a difference."""
NO_MARKS: Final = "none"
MARK_SEPARATOR: Final = " and "
_HARMLESS_MARKS: Final = frozenset({"no time source"})
"""Marks that affect no figure: fieldkit measures the offsets of clocks, so time sources are not needed."""

_RADIO_COLUMNS: Final = (
    "sender_channel",
    "receiver_channel",
    "sender_regulatory_domain",
    "receiver_regulatory_domain",
)
"""Settings of the radios. A difference causes a note."""

_MESSAGES: Final = 2
"""Maximum difference of recorded sizes in messages. A recorder starts and stops between two messages."""

DATAGRAM_FACTOR: Final = 1.5
"""Maximum ratio of datagram sizes: netcat sends 8,192 or 16,384 bytes, and fewer at the end of a file."""


@dataclass(frozen=True)
class Concern:
    """A known or possible difference between two runs.

    Attributes:
        what: The column, or a description of a value that is computed from columns.
        a: Value or values of A as text; `unknown` if its rows do not contain one.
        b: Value or values of B as text; `unknown` if its rows do not contain one.
        cells: Names of the affected conditions; empty if all conditions are affected.
        refuses: True if the difference makes the runs incomparable; otherwise it is only a note.
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


def concerns(
    pairs: Iterable[tuple[str, Repeats, Repeats]], by: Collection[str] = (), varied: Collection[str] = ()
) -> tuple[Concern, ...]:
    """Return the concerns about comparing two runs, refusals first.

    A column in `varied`, or in `VARIED` but not in `by`, causes no refusal if it has a single value in A and a single
    value in B under the condition, because it is then the variable of the comparison.

    Args:
        pairs: Name of each condition, and its valid repeats in A and in B; at least one in each run.
        by: Columns that identify a condition.
        varied: Further columns that may be the variable of the comparison.
    """
    names_by_concern: dict[Concern, list[str]] = {}
    for name, a, b in pairs:
        for concern in _pair_concerns(a, b, (VARIED - set(by)).union(varied)):
            names_by_concern.setdefault(concern, []).append(name)
    merged = (
        Concern(concern.what, concern.a, concern.b, tuple(names), concern.refuses)
        for concern, names in names_by_concern.items()
    )
    return tuple(sorted(merged, key=lambda concern: not concern.refuses))


def mixtures(repeats: Repeats, by: Sequence[str] = DEFAULT_BY) -> Iterator[str]:
    """Yield a sentence for each setting that differs within a run, although the conditions have the same name.

    Args:
        repeats: All attempts of the run.
        by: Columns that identify a condition.
    """
    for name, grouping, message in _MIXTURES:
        if len(set(repeats.keys((grouping, name)))) > len(set(repeats.column(grouping))):
            yield message
    for name in (column for column in repeats.numbers if plain_name(column) == _PAYLOAD):
        with_payload = repeats.where(np.isfinite(repeats.numbers[name]))
        if len(set(with_payload.keys((*by, name)))) > len(set(with_payload.keys(by))):
            yield "A condition has echo requests of different sizes, whose round-trip times are not comparable."
            return


def notes(a: Repeats, b: Repeats) -> Iterator[Concern]:
    """Yield notes on all repeats: different versions of fieldkit, or attempts that are in both runs."""
    yield from _compare_column("code_sha256", a, b, refuses=False)
    if common := len(_attempts(a) & _attempts(b)):
        yield Concern("attempts that are in both runs", str(common), str(common), (), refuses=False)


def _attempts(rows: Repeats) -> set[Key]:
    return {key for key in rows.keys(("trial", "protocol", "repeat", "attempt")) if key[0]}


def _pair_concerns(a: Repeats, b: Repeats, varied: Collection[str]) -> Iterator[Concern]:
    """Yield the concerns about one condition."""
    for name in SAME:
        is_varied = name in varied and all(len(set(rows.column(name))) == 1 for rows in (a, b))
        depends_on_backend = name in _KERNEL_COLUMNS and not set(a.column("backend")) & set(b.column("backend"))
        yield from _compare_column(name, a, b, refuses=not (is_varied or depends_on_backend))
    yield from _file_sizes(a, b)
    yield from _datagram_sizes(a, b)
    yield from _offload_state(a, b)
    yield from _marks(a, b)
    for name in _RADIO_COLUMNS:
        if name in a.texts and name in b.texts:
            yield from _compare_column(name, a, b, refuses=False)


def _compare_column(name: str, a: Repeats, b: Repeats, *, refuses: bool) -> Iterator[Concern]:
    """Yield a concern if the values of a column in A and B differ, or if robots or procedure are unknown."""
    text_a, text_b = _values(name, a), _values(name, b)
    is_unknown = UNKNOWN in {text_a, text_b}
    # If a column is missing in both runs, this is a concern only for columns that identify robots or procedure.
    if text_a != text_b or (is_unknown and name in _IDENTITY_COLUMNS):
        yield Concern(name, text_a, text_b, (), refuses and (not is_unknown or name in _IDENTITY_COLUMNS))


def _values(name: str, rows: Repeats) -> str:
    """Return the different values of a column as text; `unknown` if there are none."""
    values = set(rows.column(name)) - {"", None}
    return ", ".join(sorted(map(cell_text, values))) or UNKNOWN


def _file_sizes(a: Repeats, b: Repeats) -> Iterator[Concern]:
    """Yield a concern if the median sizes of the sent files differ."""
    value_a, value_b = (_median(rows.numbers["sent_bytes"]) for rows in (a, b))
    message_a, message_b = (_bytes_per("bag_messages", rows) for rows in (a, b))
    tolerance = np.fmax(SIZE_TOLERANCE * min(value_a, value_b), _MESSAGES * np.fmax(message_a, message_b))
    yield from _compare_sizes("sent_bytes, median", value_a, value_b, tolerance)


def _datagram_sizes(a: Repeats, b: Repeats) -> Iterator[Concern]:
    """Yield a concern if the median sizes of datagrams differ."""
    value_a, value_b = (_bytes_per("datagrams_sent", rows) for rows in (a, b))
    yield from _compare_sizes("bytes per datagram", value_a, value_b, (DATAGRAM_FACTOR - 1) * min(value_a, value_b))


def _bytes_per(name: str, rows: Repeats) -> float:
    """Return the median of the sent bytes per item of a count column; NaN if the counts are 0 or missing."""
    counts = rows.numbers[name]
    return _median(rows.numbers["sent_bytes"] / np.where(counts > 0, counts, np.nan))


def _compare_sizes(what: str, value_a: float, value_b: float, tolerance: float) -> Iterator[Concern]:
    """Yield a concern if two sizes in bytes differ by more than `tolerance`, or if one size is unknown (NaN)."""
    n_known = int(np.isfinite([value_a, value_b]).sum())
    if n_known == 1 or abs(value_a - value_b) > tolerance:
        yield Concern(what, _bytes(value_a), _bytes(value_b), (), refuses=n_known == 2)


def _bytes(size: float) -> str:
    return f"{size:,.0f} B" if np.isfinite(size) else UNKNOWN


def _median(values: Numbers) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else np.nan


def _offload_state(a: Repeats, b: Repeats) -> Iterator[Concern]:
    """Yield a concern if the use of segmentation offload differs, or is known for only one run."""
    value_a, value_b = (_offload_text(rows) for rows in (a, b))
    if value_a != value_b:
        yield Concern("segmentation offload", value_a, value_b, (), refuses=UNKNOWN not in {value_a, value_b})


def _offload_text(rows: Repeats) -> str:
    """Return `on` if a capture contains frames that only offload creates, otherwise `off`; `unknown` without data."""
    frames = rows.numbers["tcp_superframes"]
    finite = frames[np.isfinite(frames)]
    if not len(finite):
        return UNKNOWN
    return "on" if (finite > 0).any() else "off"


def _marks(a: Repeats, b: Repeats) -> Iterator[Concern]:
    """Yield a concern for each mark whose share of the repeats differs between A and B.

    The concern is only a note for marks that affect no figure, and if the marks of a run are unknown.
    """
    if MARKS not in a.texts or MARKS not in b.texts:
        return
    value_a, value_b = ([set(marks.split(MARK_SEPARATOR)) for marks in rows.texts[MARKS]] for rows in (a, b))
    is_known = all({""} != set().union(*run_marks) for run_marks in (value_a, value_b))
    for name in sorted(set().union(*value_a, *value_b) - {"", NO_MARKS}):
        count_a, count_b = (sum(name in marks for marks in run_marks) for run_marks in (value_a, value_b))
        if count_a * len(value_b) != count_b * len(value_a):
            texts = (f"it in {count_a} of {len(value_a)} repeats", f"it in {count_b} of {len(value_b)}")
            yield Concern(f"{MARKS}, {name}", *texts, (), refuses=is_known and name not in _HARMLESS_MARKS)
