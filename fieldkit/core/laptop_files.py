"""Names of files in an attempt's folder that only the laptop writes, for itself or for its testbed.

The modules that write these files take the names from here, and a robot's archive with one of them is refused: a
robot cannot provide what a testbed's oracle, or the operator, is to say.
"""

import re
from typing import Final

TRACK: Final = "track.csv"
LINK: Final = "link.csv"
LATENESS: Final = "lateness.txt"
MEDIUM: Final = "medium.txt"
"""Of each transfer, its name before it."""
AIR: Final = ("air.pcap", "air.csv")
"""What a testbed's oracle may write into an attempt's folder (`Oracle.record_air`)."""
POSITIONS: Final = "positions.json"
UNFETCHED: Final = "unfetched.txt"
"""Of each robot: `ROLE-unfetched.txt`."""
ANSWER: Final = "answer-"
PLAN: Final = "trial.yaml"
JOURNAL: Final = "journal.jsonl"
CAMPAIGN: Final = "campaign.yaml"
"""In the folder of a campaign, beside its trials."""
MOTION: Final = "motion.jsonl"
MANIFEST: Final = "MANIFEST.sha256"
TRIAL_CSV: Final = "trial.csv"
SUMMARY_CSV: Final = "summary.csv"
PREFLIGHT: Final = "preflight.txt"
STEP_ERROR: Final = "step-error.log"
"""The traceback of a kind of step that raised an exception."""

_NAMES: Final = (
    *(TRACK, LINK, LATENESS, MEDIUM, *AIR, POSITIONS),
    *(PLAN, JOURNAL, MOTION, MANIFEST, TRIAL_CSV, SUMMARY_CSV, PREFLIGHT, STEP_ERROR),
)
_RESERVED: Final = re.compile(
    # The name of a step comes before the first dot.
    rf"(?:[^./]*\.)?(?:{'|'.join(map(re.escape, _NAMES))}|{re.escape(ANSWER)}.*\.txt|.*-{re.escape(UNFETCHED)})\Z",
    re.IGNORECASE | re.DOTALL,
)


def answer(column: str) -> str:
    """Return the file of what the operator answered for a column."""
    return f"{ANSWER}{column}.txt"


def reserved(name: str) -> bool:
    """Return whether only the laptop writes a file of this name, in whatever case, behind whatever folders."""
    return any(_RESERVED.match(part.strip()) for part in re.split(r"[/\\]", name))
