"""Columns of the robots' states, and of the marks of a repeat.

A mark is the name of a condition that can explain a difference between repeats. A repeat with marks is valid.
"""

from typing import Final

from fieldkit.core.columns import BACKGROUND, CLOCK_DIFFERENCE_BOUNDS_S, Column, Figure, Kind, columns

MARKS: Final = "marks"
MARK_SEPARATOR: Final = " and "
NO_MARKS: Final = "none"
"""Value of the column `marks` if a source on a robot could be read, and nothing that was reported causes a mark."""

MARK_COLUMNS: Final = columns(
    160,
    (
        MARKS,
        "text",
        (
            "Conditions of the robots that can explain a difference between repeats, joined by `and`: wrong clock, "
            "no time source, clocks disagree, under-voltage, throttled, busy channel. `none` if no condition was "
            "reported; empty if no robot has a program that reports conditions."
        ),
        Figure("marks", Kind.WORDS, rank=BACKGROUND + 10),
    ),
    ("marks_reason", "text", "Reasons of the marks, with the names of the robots; empty without a mark."),
)


def declare_columns(role: str) -> tuple[Column, ...]:
    """Return the columns of one robot's state."""
    return columns(
        160,
        (
            f"{role}_time_source",
            "text",
            (
                f"Program that sets the clock of the {role}, and its time source, such as `chrony 10.0.0.1`. Empty "
                "if there was no time source before, during or after the repeat."
            ),
        ),
        (
            f"{role}_time_offset_s",
            "s",
            (
                f"Clock of the {role} minus its time source, as reported by this program: the value before, during "
                "or after the repeat with the largest sum of its magnitude and its maximum error. Empty without a "
                "time source."
            ),
            CLOCK_DIFFERENCE_BOUNDS_S,
        ),
        (
            f"{role}_time_error_s",
            "s",
            f"Maximum error of {role}_time_offset_s as reported by this program, if the time source is correct.",
        ),
        (
            f"{role}_laptop_offset_s",
            "s",
            (
                f"Clock of the {role} minus the laptop's clock at the start of the repeat, from one exchange of time "
                "stamps over the control connection."
            ),
            CLOCK_DIFFERENCE_BOUNDS_S,
        ),
        (f"{role}_laptop_offset_error_s", "s", f"Maximum error of {role}_laptop_offset_s."),
        (
            f"{role}_cpu_share",
            "share",
            f"Share of the processor time of the {role} that all programs used during the repeat.",
        ),
        (
            f"{role}_temperature_c",
            "degC",
            f"Highest temperature of all sensors of the {role}, before or after the repeat, in degrees Celsius.",
            (-100.0, 300.0),
        ),
        (
            f"{role}_power_state",
            "text",
            (
                f"Conditions of the processor of the {role} during the repeat: under-voltage, frequency capped, "
                "throttled, soft temperature limit; `normal` without these. Empty if it is not a Raspberry Pi."
            ),
        ),
        (f"{role}_battery_share", "share", f"Lowest charge of the batteries of the {role} after the repeat."),
        (f"{role}_battery_v", "V", f"Lowest voltage of the batteries of the {role} after the repeat.", (0.0, 2000.0)),
        (
            f"{role}_channel",
            "text",
            f"Channel and channel width of the radio of the {role}, before and after the repeat.",
        ),
        (
            f"{role}_regulatory_domain",
            "text",
            f"Regulatory domain of the radio of the {role}: two-letter country code, or `00` (world).",
        ),
        (
            f"{role}_other_networks",
            "count",
            (
                f"Number of other networks that the {role} receives on its channel: the larger of the counts before "
                "and after the repeat."
            ),
        ),
        (
            f"{role}_other_networks_max_dbm",
            "dBm",
            f"Strongest signal of another network on the channel of the {role}; empty if it receives none.",
            (-300.0, 100.0),
        ),
        (
            f"{role}_others_airtime_share",
            "share",
            (
                f"Share of the airtime that others use on the channel of the {role}: the larger of the shares in "
                "0.5 s before and 0.5 s after the repeat."
            ),
        ),
        (f"{role}_disk_free_bytes", "B", f"Free disk space in the home folder of the {role} after the repeat."),
    )
