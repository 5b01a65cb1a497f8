"""Rows of trial.csv and summary.csv, the same whether a repeat has just ended or is read from disk years later."""

from dataclasses import asdict
from pathlib import Path

from fieldkit import columns
from fieldkit.analysis.summary import CellRow, summarize
from fieldkit.columns import Measures, RepeatRow
from fieldkit.measure.repeat import measure
from fieldkit.model import Role
from fieldkit.trial import store
from fieldkit.trial.journal import Attempt
from fieldkit.trial.plan import Plan


def build(plan: Plan, attempt: Attempt, evidence: Path) -> RepeatRow:
    """Return the row of an attempt whose files are in the folder `evidence`; what they do not say is missing."""
    transfer = plan.transfer(attempt.repeat.protocol)
    measures = Measures() if transfer is None else measure(evidence, transfer)
    names = {role: member.name for role, member in plan.cast.items()}
    return RepeatRow(
        **asdict(measures),
        schema_version=plan.schema_version,
        trial=plan.trial,
        procedure=plan.procedure.name,
        scenario=plan.procedure.scenario,
        topology=plan.topology,
        backend=plan.backend,
        distance_m=plan.distance_m,
        distance=plan.distance,
        protocol=attempt.repeat.protocol,
        repeat=attempt.repeat.number,
        attempt=attempt.number,
        status=attempt.status,
        reason=attempt.reason or None,
        started_utc_ns=attempt.started_utc_ns,
        seed=plan.seed,
        sender=names.get(Role.SENDER),
        receiver=names.get(Role.RECEIVER),
        relay=names.get(Role.RELAY),
        profiles_sha256=plan.profiles_sha256,
        procedure_sha256=plan.procedure_sha256,
        code_sha256=plan.code_sha256,
    )


def write_rows(folder: Path, rows: list[RepeatRow]) -> None:
    """Write trial.csv of a trial."""
    store.write(folder / store.TRIAL_CSV, columns.to_csv(RepeatRow, rows).encode())


def write_summary(folder: Path, plan: Plan, rows: list[RepeatRow]) -> tuple[CellRow, ...]:
    """Write summary.csv of a trial and return what stands in it."""
    cells = summarize(rows, seed=plan.seed)
    store.write(folder / store.SUMMARY_CSV, columns.to_csv(CellRow, cells).encode())
    return cells
