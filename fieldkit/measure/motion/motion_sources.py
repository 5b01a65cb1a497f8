"""Sources of what is known of moving robots, and the checks between them: drives, flights, telemetry, positions."""

from typing import Final

from fieldkit.core.crosschecks import CheckOutcome, CrossCheck

_WINDOW: Final = "the robot's clock around the attempt"

OF_DRIVE: Final = (
    CrossCheck(
        "way of a drive",
        ("drive_*",),
        "`drive.jsonl`: places, way and speed of each line",
        (
            "its own line numbers and checksum",
            "the way that the wheels went, against the places",
            "the way and speed of the procedure",
            _WINDOW,
        ),
        "1 m off the way; half more than the speed, and 0.1 m/s; 25 % and 5 cm a line for odometry that jitters",
    ),
    CrossCheck(
        "distance of a drive",
        ("drive_out_m", "drive_farthest_m", "drive_speed_*", "drive_back_*"),
        "`drive.jsonl`: places",
        ("`track.csv`", "positions that a step or a person recorded"),
        "a tenth for drift of odometry, and 0.5 m, or 10 m if satellites give the other",
        CheckOutcome.WITHHELD,
    ),
)

OF_FLIGHT: Final = (
    CrossCheck(
        "way of a flight",
        ("fly_*",),
        "`fly.jsonl`: place and speed of each line",
        (
            "its own line numbers and checksum",
            "the speeds, against the places",
            "the way, height and limits of the procedure and the profile",
            "`mavlink.tlog` of the same drone: LOCAL_POSITION_NED",
            _WINDOW,
        ),
        "5 m, which an autopilot's estimate may be off by; half more than the speed, and 2 m/s",
    ),
)

OF_TELEMETRY: Final = (
    CrossCheck(
        "frames of telemetry",
        ("mavlink_*",),
        "`mavlink.tlog`: frames and their times",
        ("`mavlink.json`: frames, checksum, time of the end", "the checksum of each frame", _WINDOW),
        "1 ms between two times, for a clock that is slewed",
    ),
)

OF_POSITIONS: Final = (
    CrossCheck(
        "planned places in the record",
        ("positions_from",),
        "`positions.json`: places and starts",
        ("the placement in `trial.yaml`",),
        "1 mm of rounding: the laptop wrote both",
    ),
    CrossCheck(
        "recorded positions",
        ("*_distance_*", "*_relative_speed_m_s", "*_sender_speed_m_s"),
        "positions that a step or a person recorded",
        ("the placement in `trial.yaml`",),
        "a tenth of the distance, and 2 m, or 15 m by satellites: places are paced off, and receivers err",
        CheckOutcome.WITHHELD,
    ),
    CrossCheck(
        "error of the robots' clocks",
        ("positions_clock_error_s",),
        "`positions.json`: clocks, asked before and after",
        (),
        "the laptop is the only one that asks",
        CheckOutcome.UNCHECKED,
    ),
)
