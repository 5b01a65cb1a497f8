"""All figures of an attempt's evidence, computed without a plan: transfer, ping, captures, faults and testbed."""

from pathlib import Path
from typing import Any

from fieldkit.core.columns import Measured
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FaultKind, Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import oracle_delays, outage, ping, tcpdump_log, track
from fieldkit.measure.transfers import transfer_columns, transfer_measures
from fieldkit.measure.transfers.transfer_spec import Transfer
from fieldkit.trial.columns import measured_columns


class Measures(dict[str, Any]):
    """Figures by column, also available as attributes; a missing figure has no key, and its attribute is None."""

    def __init__(self, **values: Any) -> None:  # noqa: ANN401 (any value of a column)
        super().__init__({name: value for name, value in values.items() if value is not None})

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 (as above)
        if name not in COLUMNS:
            raise AttributeError(name)
        return self.get(name)


COLUMNS = frozenset(column.name for column in measured_columns())


def all_columns(figures_by_column: Measures) -> dict[str, Any]:
    """All columns; None for a missing figure."""
    return {name: figures_by_column.get(name) for name in COLUMNS}


def measure(folder: Path, transfer: Transfer | None) -> Measures:
    """All figures from the evidence in `folder`; each column either has a value or is missing."""
    evidence = AttemptEvidence(folder)
    pings = evidence.read_or_none(ping.read, ping.FILE)
    positions = evidence.read_or_none(track.read, track.FILE)
    reply_times_ns = [at for answer in pings.answers if (at := answer.at_utc_ns)] if pings else []
    measured = oracle_delays.measure_lateness(
        evidence.read_or_none(oracle_delays.read_lateness, oracle_delays.LATENESS_FILE)
    ) | ping.measure(pings)
    measured |= track.measure(positions, ping.MOTION_COLUMNS, (Role.SENDER, Role.RECEIVER), reply_times_ns)
    if transfer is not None:
        measured |= transfer_measures.measure(evidence, transfer) | _captures(evidence)
        names = {column.name for column in transfer_columns.COLUMNS}
        assert names <= measured.values.keys() | measured.missing.keys()
    for kind in FaultKind:
        try:
            measured |= outage.measure(kind, evidence.read(outage.read, "", kind))
        except EvidenceError:
            continue
    assert not measured.values.keys() & measured.missing.keys()
    return Measures(**measured.values)


def _captures(evidence: AttemptEvidence) -> Measured:
    measured = Measured()
    for role in (Role.SENDER, Role.RECEIVER):
        capture = evidence.undamaged_capture(tcpdump_log.capture_file(role))
        log = evidence.read_or_none(tcpdump_log.read, tcpdump_log.capture_log_file(tcpdump_log.capture_file(role)))
        frame_count = capture.frames if capture else None
        dropped = log.dropped_by_kernel if log else None
        measured |= Measured.from_optional(
            {f"{role}_captured": frame_count, f"{role}_capture_dropped": dropped}, "not available"
        )
    return measured
