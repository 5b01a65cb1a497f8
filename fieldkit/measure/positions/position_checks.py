"""Cross-checks between the sources of positions of robots."""

from typing import Final

from fieldkit.core.crosschecks import CheckOutcome, CrossCheck

POSITION_CHECKS: Final = (
    CrossCheck(
        "planned positions in the record",
        ("positions_from",),
        "`positions.json`: positions and their start times",
        ("the placement in `trial.yaml`",),
        "1 mm of rounding: the laptop wrote both",
    ),
    CrossCheck(
        "recorded positions",
        ("*_distance_*", "*_relative_speed_m_s", "*_sender_speed_m_s"),
        "positions that a step or a person recorded",
        ("the placement in `trial.yaml`",),
        "10 % of the distance plus 2 m (plus 15 m for satellite receivers), for errors of placement and of receivers",
        CheckOutcome.WITHHELD,
    ),
    CrossCheck(
        "error of the robots' clocks",
        ("positions_clock_error_s",),
        "`positions.json`: clocks, read before and after",
        (),
        "only the laptop reads them",
        CheckOutcome.UNCHECKED,
    ),
)
