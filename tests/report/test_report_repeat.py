"""The repeat that the time line shows by default."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from fieldkit.analysis.cells import aggregate
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.report.contents import repeat_to_draw
from fieldkit.report.trial_folders import Evidence
from tests.helpers.tables import ROW, RepeatRow, parsed, replace

TCP = replace(
    ROW,
    protocol="tcp",
    **dict.fromkeys(("ip_packets_sent", "ip_packets_received", "ip_loss", "file_loss", "rtt_median_s", "transfer_s")),
)
FAR = replace(TCP, distance="55ft", distance_m=16.764)


@dataclass(frozen=True, eq=False)
class PartialEvidence(Evidence):
    """Evidence that exists only for some rows of a table."""

    rows_with_evidence: frozenset[int] = frozenset()

    def attempt(self, row: int) -> AttemptEvidence | None:
        return AttemptEvidence(Path("repeats")) if row in self.rows_with_evidence else None


def selected_row(rows: Sequence[RepeatRow], *missing: int) -> int | None:
    """Return the row that is selected for the time line if all rows have evidence, except `missing`."""
    table = parsed([replace(row, repeat=1 + number) for number, row in enumerate(rows)])
    rows_with_evidence = frozenset(range(len(rows))).difference(missing)
    return repeat_to_draw(
        aggregate(table), PartialEvidence(table, {}, (), frozenset(), frozenset(), rows_with_evidence), ""
    )


def rows_with(row: RepeatRow, name: str, *values: float) -> list[RepeatRow]:
    return [replace(row, **{name: value}) for value in values]


LOST = [*rows_with(TCP, "tcp_byte_loss", 0.3, 0.2, 0.1), *rows_with(FAR, "tcp_byte_loss", 0.6, 0.0, 0.9, 0.7, 0.0)]


@pytest.mark.parametrize(
    ("rows", "missing", "row"),
    [
        (
            LOST,
            (),
            6,
        ),  # the condition of most loss, with the median of 0.6, 0.7 and 0.9; repeats without loss are excluded
        (LOST, (5,), 3),  # the lower of two values
        (LOST, (3, 5, 6), 1),  # the repeats with loss in this condition have no evidence
        (
            rows_with(TCP, "tcp_byte_loss", 0.0, 0.0) + rows_with(FAR, "rtt_loss", 0.1),
            (),
            None,
        ),  # a share without counts
        (
            rows_with(TCP, "transfer_s", 1.0, 3.0, 2.0) + rows_with(FAR, "transfer_s", 5.0, 4.0, 9.0),
            (),
            3,
        ),  # no losses
        (rows_with(replace(TCP, tcp_byte_loss=0.0), "rtt_median_s", 0.3, 0.1, 0.2), (), 2),
        (LOST, range(len(LOST)), None),
        ([replace(LOST[0], status="void"), *LOST[1:3]], (), 2),
        (
            [replace(LOST[0], file_loss=0.5), *rows_with(TCP, "file_loss", 0.9)],
            (),
            0,
        ),  # TCP byte loss takes precedence
    ],
)
def test_default_is_the_repeat_of_median_loss_in_the_condition_of_most_loss(
    rows: list[RepeatRow], missing: Sequence[int], row: int | None
) -> None:
    assert selected_row(rows, *missing) == row
