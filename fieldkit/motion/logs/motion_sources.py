"""Cross-checks between the sources of data on moving robots: drives, flights, telemetry, positions."""

from typing import Final

from fieldkit.core.crosschecks import CheckOutcome, CrossCheck

_WINDOW: Final = "the robot's clock before and after the attempt"

OF_DRIVE: Final = (
    CrossCheck(
        quantity="path of a drive",
        columns=("drive_*",),
        source="`drive.jsonl`: position, driven distance and speed of each line",
        against=(
            "its line numbers and checksum",
            "the driven distance, compared with the positions",
            "the path and speed of the procedure",
            _WINDOW,
        ),
        tolerance=(
            "position: 1 m from the path; speed: 50 % plus 0.1 m/s above the commanded one; driven distance: 25 % "
            "plus 5 cm per line above the straight line, because of odometry jitter"
        ),
    ),
    CrossCheck(
        quantity="distance of a drive",
        columns=("drive_out_m", "drive_farthest_m", "drive_speed_*", "drive_back_*"),
        source="`drive.jsonl`: positions",
        against=("`track.csv`", "positions that a step or a person recorded"),
        tolerance=(
            "distance: 10 % for odometry drift, plus 0.5 m, or plus 10 m if the other source uses satellites; "
            "`track.csv`: also the distance that the robot drives in 1 s; recorded positions may be farther away"
        ),
        outcome=CheckOutcome.WITHHELD,
    ),
)

OF_FLIGHT: Final = (
    CrossCheck(
        quantity="path of a flight",
        columns=("fly_*",),
        source="`fly.jsonl`: position and speed of each line",
        against=(
            "its line numbers and checksum",
            "the speeds, compared with the positions",
            "the path, height and limits of the procedure and the profile",
            "`mavlink.tlog` of the same drone: LOCAL_POSITION_NED",
            _WINDOW,
        ),
        tolerance=(
            "position: 5 m for errors of the autopilot's estimate; extent of the telemetry: 41 % plus 5 m above that "
            "of the log, because the axes differ; speed: 50 % plus 2 m/s above its limit"
        ),
    ),
)

OF_TELEMETRY: Final = (
    CrossCheck(
        quantity="frames of telemetry",
        columns=("mavlink_*",),
        source="`mavlink.tlog`: frames and their times",
        against=("`mavlink.json`: frames, checksum, time of the end", "the checksum of each frame", _WINDOW),
        tolerance="a time may be up to 1 ms earlier than the previous one, because the clock may be slewed",
    ),
)
