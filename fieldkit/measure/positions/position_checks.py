"""Cross-checks between the sources of positions of robots."""

from typing import Final

from fieldkit.core.crosschecks import CheckOutcome, CrossCheck

POSITION_CHECKS: Final = (
    CrossCheck(
        quantity="stored planned positions",
        columns=("positions_from",),
        source="`positions.json`: positions and their start times",
        against=("the placement in `trial.yaml`",),
        tolerance="1 mm for rounding, because the laptop wrote both",
    ),
    CrossCheck(
        quantity="recorded positions",
        columns=("*_distance_*", "*_relative_speed_m_s", "*_sender_speed_m_s"),
        source="positions that a step or a person recorded",
        against=("the placement in `trial.yaml`",),
        tolerance=(
            "distances may differ by 10 % plus 2 m, or plus 15 m with satellite receivers, because of errors of "
            "placement and of receivers"
        ),
        outcome=CheckOutcome.WITHHELD,
    ),
    CrossCheck(
        quantity="error of the robots' clocks",
        columns=("positions_clock_error_s",),
        source="`positions.json`: the robots' clocks, read before and after the recording",
        against=(),
        tolerance="no second source reads the clocks",
        outcome=CheckOutcome.UNCHECKED,
    ),
)
