"""Cross-checks between the sources of data on moving robots: drives, flights, telemetry, positions."""

from typing import Final

from fieldkit.core.crosschecks import CheckOutcome, CrossCheck

_WINDOW: Final = "the robot's clock around the attempt"

OF_DRIVE: Final = (
    CrossCheck(
        "path of a drive",
        ("drive_*",),
        "`drive.jsonl`: position, driven distance and speed of each line",
        (
            "its line numbers and checksum",
            "the driven distance, compared with the positions",
            "the path and speed of the procedure",
            _WINDOW,
        ),
        "1 m from the path; 50 % of the speed plus 0.1 m/s; 25 % plus 5 cm per line for jitter of the odometry",
    ),
    CrossCheck(
        "distance of a drive",
        ("drive_out_m", "drive_farthest_m", "drive_speed_*", "drive_back_*"),
        "`drive.jsonl`: positions",
        ("`track.csv`", "positions that a step or a person recorded"),
        "10 % for drift of the odometry plus 0.5 m, or plus 10 m if the other source uses satellites",
        CheckOutcome.WITHHELD,
    ),
)

OF_FLIGHT: Final = (
    CrossCheck(
        "path of a flight",
        ("fly_*",),
        "`fly.jsonl`: position and speed of each line",
        (
            "its line numbers and checksum",
            "the speeds, compared with the positions",
            "the path, height and limits of the procedure and the profile",
            "`mavlink.tlog` of the same drone: LOCAL_POSITION_NED",
            _WINDOW,
        ),
        "5 m for errors of an autopilot's position estimate; 50 % of the speed plus 2 m/s",
    ),
)

OF_TELEMETRY: Final = (
    CrossCheck(
        "frames of telemetry",
        ("mavlink_*",),
        "`mavlink.tlog`: frames and their times",
        ("`mavlink.json`: frames, checksum, time of the end", "the checksum of each frame", _WINDOW),
        "1 ms between two times, because the clock may be slewed",
    ),
)
