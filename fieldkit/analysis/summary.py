"""What the repeats under one condition say together."""

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from fieldkit.analysis.statistics import Statistic, bootstrap, wilson
from fieldkit.columns import CellRow, RepeatRow
from fieldkit.model import Status

__all__ = ["CellRow", "summarize"]

_KEY: Final = ("procedure", "scenario", "topology", "backend", "distance", "distance_m", "protocol")

# Layer of loss, and the columns that count what arrived of what was sent.
_COUNTED: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    {
        "ip_loss": ("ip_packets_received", "ip_packets_sent"),
        "datagram_loss": ("datagrams_received", "datagrams_sent"),
        "paper_loss": ("paper_received", "paper_packets"),
        "rtt_loss": ("rtt_received", "rtt_sent"),
    }
)
# Shares of bytes: these are lost by the packet, so a score interval over bytes would be far too narrow.
_AVERAGED: Final = ("tcp_byte_loss", "byte_loss", "file_loss")
_LOCATED: Final = ("rtt_median_s", "transfer_s")


def summarize(rows: Sequence[RepeatRow], seed: int) -> tuple[CellRow, ...]:
    """Return one row per condition, in the order in which `rows` first names them; only valid rows are measured.

    Args:
        rows: Attempts at repeats, void and failed ones too.
        seed: Of the bootstrap; not negative. A cell's intervals depend on it and on the cell's own rows alone.
    """
    cells: dict[tuple[object, ...], list[RepeatRow]] = {}
    for row in rows:
        cells.setdefault(tuple(getattr(row, name) for name in _KEY), []).append(row)
    return tuple(_cell(dict(zip(_KEY, key, strict=True)), group, seed) for key, group in cells.items())


def _cell(key: Mapping[str, Any], group: Sequence[RepeatRow], seed: int) -> CellRow:
    valid = [row for row in group if row.status == Status.VALID]
    columns: dict[str, Any] = {}
    for layer, (arrived, sent) in _COUNTED.items():
        columns |= _pooled(valid, layer, arrived, sent) | _spread(valid, layer)
    for layer in _AVERAGED:
        columns |= _over_repeats(valid, layer, "mean", seed) | _spread(valid, layer)
    for name in _LOCATED:
        columns |= _over_repeats(valid, name, "median", seed)
    return CellRow(
        **key,
        n_valid=len(valid),
        n_void=sum(row.status == Status.VOID for row in group),
        n_failed=sum(row.status == Status.FAILED for row in group),
        **columns,
    )


def _pooled(rows: Sequence[RepeatRow], layer: str, arrived: str, sent: str) -> dict[str, float]:
    """Return the loss over all packets of `rows` that have a loss in this layer."""
    counted = [row for row in rows if getattr(row, layer) is not None]
    received: int = sum(getattr(row, arrived) for row in counted)
    total: int = sum(getattr(row, sent) for row in counted)
    if not total:
        return {}
    if received > total:
        return {layer: 1 - received / total}
    interval = wilson(total - received, total)
    return {layer: interval.value, f"{layer}_low": interval.low, f"{layer}_high": interval.high}


def _spread(rows: Sequence[RepeatRow], layer: str) -> dict[str, float]:
    values = list(_values(rows, layer))
    return {f"{layer}_min": min(values), f"{layer}_max": max(values)} if values else {}


def _over_repeats(rows: Sequence[RepeatRow], name: str, statistic: Statistic, seed: int) -> dict[str, float]:
    values = list(_values(rows, name))
    if len(values) < 2:
        return {name: values[0]} if values else {}
    # The same draws for every column and cell: none changes when another is added.
    interval = bootstrap(values, statistic, np.random.default_rng(seed))
    return {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}


def _values(rows: Sequence[RepeatRow], name: str) -> Iterator[float]:
    return (value for row in rows if (value := getattr(row, name)) is not None)
