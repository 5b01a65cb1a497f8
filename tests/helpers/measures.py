"""All figures of an attempt's folder at once, without a plan: of transfer, ping, captures, faults and testbed."""

from pathlib import Path
from typing import Any

from fieldkit.core.columns import Measured
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FaultKind, Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import lateness, ping, recovery, tcpdump_log, track
from fieldkit.measure.transfers import columns as of_transfers
from fieldkit.measure.transfers import figures
from fieldkit.measure.transfers.transfer import Transfer
from fieldkit.trial.columns import measures


class Measures(dict[str, Any]):
    """Figures by column, also as attributes; one that is missing is not there, and None as an attribute."""

    def __init__(self, **values: Any) -> None:  # noqa: ANN401 (any value of a column)
        super().__init__({name: value for name, value in values.items() if value is not None})

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 (as above)
        if name not in COLUMNS:
            raise AttributeError(name)
        return self.get(name)


COLUMNS = frozenset(column.name for column in measures())


def every(found: Measures) -> dict[str, Any]:
    """Return every column, None for one that is missing."""
    return {name: found.get(name) for name in COLUMNS}


def measure(folder: Path, transfer: Transfer | None) -> Measures:
    """Return what the evidence in `folder` says; each column has a value, or is said to be missing, once."""
    evidence = AttemptEvidence(folder)
    pings = evidence.read_or_none(ping.read, ping.FILE)
    where = evidence.read_or_none(track.read, track.FILE)
    replied_ns = [at for one in pings.answers if (at := one.at_utc_ns)] if pings else []
    found = lateness.measure(evidence.read_or_none(lateness.read, lateness.FILE)) | ping.measure(pings)
    found |= track.measure(where, ping.WAY_COLUMNS, (Role.SENDER, Role.RECEIVER), replied_ns)
    if transfer is not None:
        found |= figures.measure(evidence, transfer) | _captures(evidence)
        assert not {column.name for column in of_transfers.COLUMNS} - found.values.keys() - found.missing.keys()
    for kind in FaultKind:
        try:
            found |= recovery.measure(kind, evidence.read(recovery.read, "", kind))
        except EvidenceError:
            continue
    assert not found.values.keys() & found.missing.keys()
    return Measures(**found.values)


def _captures(evidence: AttemptEvidence) -> Measured:
    found = Measured()
    for role in (Role.SENDER, Role.RECEIVER):
        capture = evidence.whole_capture(tcpdump_log.capture_file(role))
        log = evidence.read_or_none(tcpdump_log.read, tcpdump_log.log_file(role))
        captured = capture.frames if capture else None
        dropped = log.dropped_by_kernel if log else None
        found |= Measured.of({f"{role}_captured": captured, f"{role}_capture_dropped": dropped}, "not at hand")
    return found
