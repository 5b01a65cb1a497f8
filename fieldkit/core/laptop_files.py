"""Names of files that only the laptop writes, most of them into the folder of an attempt.

The modules that write these files import the names. An archive from a robot that contains a reserved name
(`is_reserved`) is refused, because a robot must not provide the data of the operator or of a modelled radio
(`backends.protocols.Oracle`).
"""

import re
from typing import Final

TRACK: Final = "track.csv"
LINK: Final = "link.csv"
LATENESS: Final = "lateness.txt"
MEDIUM: Final = "medium.txt"
"""File of each transfer; the name of the transfer is its prefix."""
AIR: Final = ("air.pcap", "air.csv")
"""Files that a modelled radio may write into an attempt's folder (`Oracle.record_air`)."""
POSITIONS: Final = "positions.json"
EXCHANGES: Final = "exchanges.txt"
UNFETCHED: Final = "unfetched.txt"
"""File of each robot: `ROLE-unfetched.txt`."""
ANSWER: Final = "answer-"
FAULT: Final = "fault-"
FAULT_TIMES: Final = "-times.txt"
"""File of each fault: `fault-KIND-times.txt`."""
TELEMETRY: Final = ("-telemetry-", "-laptop.txt")
"""Texts before and after the name of a telemetry source that the laptop queries: `ROLE-telemetry-NAME-laptop.txt`."""
PLAN: Final = "trial.yaml"
JOURNAL: Final = "journal.jsonl"
CAMPAIGN: Final = "campaign.yaml"
"""File in the folder of a campaign, next to the folders of its trials."""
MOTION: Final = "motion.jsonl"
MANIFEST: Final = "MANIFEST.sha256"
TRIAL_CSV: Final = "trial.csv"
SUMMARY_CSV: Final = "summary.csv"
SWEEP: Final = "sweep.json"
"""File in the folder of a sweep of simulations."""
SWEEP_RESULTS: Final = "results"
"""Dataset of a sweep: a folder of Parquet files, partitioned by the factors of the sweep."""
PREFLIGHT: Final = "preflight.txt"
STEP_ERROR: Final = "step-error.log"
"""Traceback of an exception that a step raised."""

_NAMES: Final = (
    *(TRACK, LINK, LATENESS, MEDIUM, *AIR, POSITIONS, EXCHANGES),
    *(PLAN, JOURNAL, MOTION, MANIFEST, TRIAL_CSV, SUMMARY_CSV, PREFLIGHT, STEP_ERROR),
)
_RESERVED: Final = re.compile(
    # The name of a step comes before the first dot.
    rf"(?:[^./]*\.)?(?:{'|'.join(map(re.escape, _NAMES))}|{re.escape(ANSWER)}.*\.txt|.*-{re.escape(UNFETCHED)}"
    rf"|{re.escape(FAULT)}.*{re.escape(FAULT_TIMES)}|.*{re.escape(TELEMETRY[0])}.*{re.escape(TELEMETRY[1])}(?:\.gz)?)\Z",
    re.IGNORECASE | re.DOTALL,
)


def answer_file(column: str) -> str:
    """Return the name of the file with the operator's answer for a column."""
    return f"{ANSWER}{column}.txt"


def telemetry_file(role: str, name: str) -> str:
    """Return the name of the file with the outputs of a telemetry source that the laptop queries."""
    return f"{role}{TELEMETRY[0]}{name}{TELEMETRY[1]}"


def fault_times_file(kind: str) -> str:
    """Return the name of the file with the times of a fault of this kind."""
    return f"{FAULT}{kind}{FAULT_TIMES}"


def is_reserved(name: str) -> bool:
    """Return True if any part of a path is the name of a file that only the laptop writes into folders of trials.

    The case of letters is ignored.
    """
    return any(_RESERVED.match(part.strip()) for part in re.split(r"[/\\]", name))
