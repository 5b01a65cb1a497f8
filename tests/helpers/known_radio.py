"""Labs whose radio has a known loss and delay, and complete trials in them."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.helpers.labs import write_procedure
from tests.helpers.nightly import mark_nightly
from tests.helpers.runs import Run, fieldkit, only_trial, rows
from tests.helpers.texts import procedure, site

LOSSES_PERCENT = (0, 1, 10, 30)
IN_CI, AT_NIGHT = 5, 20
"""Number of repeats of each trial."""
REPEATS = [IN_CI, pytest.param(AT_NIGHT, marks=pytest.mark.nightly)]
"""Parameters of a module fixture. Each test that uses the fixture runs with both numbers."""
LOSSES_IN_CI = (0, 10, 30)
"""In few repeats, a loss of 1 % can hardly be distinguished from no loss."""
EACH_LOSS = mark_nightly(LOSSES_PERCENT, in_ci=LOSSES_IN_CI)
"""Parameters of a test."""

Table = list[dict[str, str]]


class LossyTables(dict[str, Table]):
    """Rows of trials by the loss in percent; a loss that CI does not test is measured when its rows are read.

    Args:
        measure: Measures the rows of several losses in parallel.
    """

    def __init__(self, measure: Callable[[Sequence[int]], dict[str, Table]]) -> None:
        super().__init__(measure(LOSSES_IN_CI))
        self._measure = measure

    def __missing__(self, percent: str) -> Table:
        self.update(self._measure((int(percent),)))
        return self[percent]


SITE = site(emulated="ros: builtin, radio: RADIO")

# The steps of the paper, shortened: a bag of about 15 kB per 0.5 s, and few pings.
PROCEDURE = procedure(
    "quick",
    """\
- record: {robot: sender, topics: [TOPIC], duration: 1s, name: scan}
- capture:
    robots: [sender, receiver]
    during:
      - transfer: {from: sender, to: receiver, idle: 1s, limit: 600s}
      - ping: {from: sender, to: receiver, count: PINGS, interval: 20ms}
""",
    protocols="tcp, udp",
    repeats="REPEATS",
    attempts=3,
)


def make_lab(lab: Path, radio: str, *, topic: str = "/scan", pings: int = 1, repeats: int = IN_CI) -> Path:
    lab.mkdir()
    (lab / "fieldkit.yaml").write_text(SITE.replace("RADIO", radio), encoding="utf-8")
    text = PROCEDURE.replace("TOPIC", topic).replace("PINGS", str(pings)).replace("REPEATS", str(repeats))
    write_procedure(lab, text)
    return lab


def measured(runs: dict[Path, Run]) -> dict[str, list[dict[str, str]]]:
    for run in runs.values():
        assert run.code == 0, run.err + run.out
    # A packet that arrives while tcpdump exits makes an attempt void, and the repeat is then measured again.
    return {lab.name: [row for row in rows(only_trial(lab)) if row["status"] == "valid"] for lab in runs}


def run_all(labs: list[Path], *arguments: str) -> dict[str, list[dict[str, str]]]:
    """Run the same trial in all labs concurrently; return the rows of valid repeats by the lab's name."""
    with ThreadPoolExecutor(len(labs)) as pool:
        runs = list(pool.map(lambda lab: fieldkit(lab, "trial", "quick", "5m", *arguments), labs))
    return measured(dict(zip(labs, runs, strict=True)))
