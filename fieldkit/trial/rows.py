"""Rows of trial.csv and summary.csv, the same whether a repeat has just ended or is read from disk years later."""

from dataclasses import asdict
from pathlib import Path

from fieldkit.analysis import repeats, tables
from fieldkit.analysis.cells import DEFAULT_BY, Cell, aggregate
from fieldkit.core import columns, files
from fieldkit.core.columns import RepeatRow, of_fault
from fieldkit.core.model import FaultKind, Role
from fieldkit.measure.repeat import measure
from fieldkit.trial import store
from fieldkit.trial.journal import Attempt
from fieldkit.trial.plan import Plan


def build(plan: Plan, attempt: Attempt, evidence: Path) -> RepeatRow:
    """Return the row of an attempt whose files are in the folder `evidence`; what they do not say is missing."""
    transfer = plan.transfer(attempt.repeat.protocol)
    measures = measure(evidence, transfer)
    names = {role: member.name for role, member in plan.cast.items()}
    return RepeatRow(
        **asdict(measures),
        schema_version=columns.SCHEMA_VERSION,
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


def in_words(row: RepeatRow) -> str:
    """Return the most important numbers of a row for people: `IP loss 3.2 %, RTT 12.1 ms`."""
    layers = {"IP loss": row.ip_loss, "datagram loss": row.datagram_loss, "file loss": row.file_loss}
    parts = [f"{name} {100 * share:.1f} %" for name, share in layers.items() if share is not None]
    if row.tcp_retransmitted_segments is not None:
        parts.append(f"{row.tcp_retransmitted_segments} retransmitted")
    if row.rtt_median_s is not None:
        parts.append(f"RTT {1e3 * row.rtt_median_s:.1f} ms")
    for kind in FaultKind:
        outage_s, recovered = (getattr(row, of_fault(kind, what)) for what in ("outage_s", "recovered"))
        if recovered is not None:
            parts.append(f"{kind}: " + (f"gone for {outage_s:.1f} s" if recovered else "did not come back"))
    return ", ".join(parts)


def write_rows(folder: Path, rows: list[RepeatRow]) -> None:
    """Write trial.csv of a trial."""
    files.write(folder / store.TRIAL_CSV, columns.to_csv(RepeatRow, rows).encode())


def write_summary(folder: Path, rows: list[RepeatRow]) -> tuple[Cell, ...]:
    """Write summary.csv of a trial and return what stands in it."""
    cells = aggregate(repeats.of_rows(rows))
    files.write(folder / store.SUMMARY_CSV, tables.to_csv(DEFAULT_BY, cells).encode())
    return cells
