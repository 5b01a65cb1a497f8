"""Which repeat has its time line in a report that was asked for none."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from fieldkit.analysis.cells import aggregate
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.report.contents import repeat_to_draw
from fieldkit.report.evidence import Evidence
from tests.helpers.tables import ROW, RepeatRow, parsed, replace

TCP = replace(
    ROW,
    protocol="tcp",
    **dict.fromkeys(("ip_packets_sent", "ip_packets_received", "ip_loss", "file_loss", "rtt_median_s", "transfer_s")),
)
FAR = replace(TCP, distance="55ft", distance_m=16.764)


@dataclass(frozen=True, eq=False)
class Imagined(Evidence):
    """A table beside which the evidence of some rows is at hand."""

    kept: frozenset[int] = frozenset()

    def attempt(self, row: int) -> AttemptEvidence | None:
        return AttemptEvidence(Path("repeats")) if row in self.kept else None


def drawn(rows: Sequence[RepeatRow], *gone: int) -> int | None:
    """The row whose time line is drawn, where the evidence of all is at hand but of those."""
    table = parsed([replace(row, repeat=1 + number) for number, row in enumerate(rows)])
    kept = frozenset(range(len(rows))).difference(gone)
    return repeat_to_draw(aggregate(table), Imagined(table, {}, (), frozenset(), kept), "")


def each(row: RepeatRow, name: str, *values: float) -> list[RepeatRow]:
    return [replace(row, **{name: value}) for value in values]


LOST = [*each(TCP, "tcp_byte_loss", 0.3, 0.2, 0.1), *each(FAR, "tcp_byte_loss", 0.6, 0.0, 0.9, 0.7, 0.0)]


@pytest.mark.parametrize(
    ("rows", "gone", "row"),
    [
        (LOST, (), 6),  # where most is lost, the median of 0.6, 0.7 and 0.9: none that lost nothing
        (LOST, (5,), 3),  # the lower one of two
        (LOST, (3, 5, 6), 1),  # of those that lost there none is at hand
        (each(TCP, "tcp_byte_loss", 0.0, 0.0) + each(FAR, "rtt_loss", 0.1), (), None),  # a share without its counts
        (each(TCP, "transfer_s", 1.0, 3.0, 2.0) + each(FAR, "transfer_s", 5.0, 4.0, 9.0), (), 3),  # nothing lost
        (each(replace(TCP, tcp_byte_loss=0.0), "rtt_median_s", 0.3, 0.1, 0.2), (), 2),
        (LOST, range(len(LOST)), None),
        ([replace(LOST[0], status="void"), *LOST[1:3]], (), 2),
        ([replace(LOST[0], file_loss=0.5), *each(TCP, "file_loss", 0.9)], (), 0),  # TCP's own loss says more
    ],
)
def test_a_repeat_of_median_loss_where_most_is_lost(
    rows: list[RepeatRow], gone: Sequence[int], row: int | None
) -> None:
    assert drawn(rows, *gone) == row
