"""Plans and tables of trials with different procedures: named transfers and pings, and the meter of a vendor."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fieldkit.config import schema
from fieldkit.core import columns
from fieldkit.core.columns import Column, Figure, Kind, Value, with_step_name
from fieldkit.core.model import Protocol
from fieldkit.measure.evidence import ping
from fieldkit.measure.transfers.transfer_columns import COLUMNS
from fieldkit.trial import rows
from fieldkit.trial.frozen import freeze
from fieldkit.trial.plan import Plan
from tests.helpers.casts import los_plan

NAMED_STEP_COLUMNS = (
    *(with_step_name(step, column) for step in ("up", "down") for column in COLUMNS),
    *(with_step_name(step, column) for step in ("p502", "p8192") for column in ping.COLUMNS),
)
"""Columns of two named transfers and two named pings."""
VENDOR_COLUMNS = columns.columns(
    100,
    ("probe.level", "dBm", "Reading of the vendor's meter.", Figure("probe: level", Kind.MEDIAN)),
    ("probe.volt", "V", "Voltage of the battery.", Figure("probe: voltage", Kind.MEAN)),
    ("probe.resets", "count", "Number of restarts of the meter.", Figure("probe: resets", Kind.MEAN)),
    ("probe.locked", "bool", "True if the meter had found its channel.", Figure("probe: locked", Kind.FLAG)),
    ("probe.firmware", "text", "Name of the meter's firmware."),
    ("wind", "text", "The operator's note about the wind."),
)
"""Columns of a third-party package, and an operator's note."""


def plan(name: str, *, distance: str, metres: float, columns: Sequence[Column]) -> Plan:
    """The plan of a trial whose steps measure the columns."""
    changes = {"trial": name, "distance": distance, "distance_m": metres, "columns": freeze(columns)}
    return los_plan().model_copy(update=changes)


def write(folder: Path, plan: Plan, table: Sequence[Mapping[str, Value]], *, with_plan: bool = True) -> Path:
    """Write a trial to a new folder in `folder`; return the new folder, which has the name of the trial."""
    trial = folder / plan.trial
    trial.mkdir(parents=True)
    (trial / "trial.csv").write_text(rows.to_csv(table, plan.table), encoding="utf-8")
    if with_plan:
        (trial / "trial.yaml").write_text(schema.dump(plan), encoding="utf-8")
    return trial


def valid_rows(plan: Plan, *, repeats: int = 8, seed: int = 1, level_dbm: float = -40.0) -> list[dict[str, Value]]:
    """Valid rows of a trial; each column has a possible value.

    Each column has a separate random stream, so that an additional column does not change the others.
    """
    random = {column.name: np.random.default_rng([seed, *column.name.encode()]) for column in plan.table}
    table = []
    for protocol in Protocol:
        for number in range(1, repeats + 1):
            row: dict[str, Value] = {column.name: _value(column, random[column.name]) for column in plan.table}
            for column in plan.table:
                figure = column.figure
                if figure is not None and figure.kind is Kind.COUNTED:
                    assert figure.sent is not None
                    assert figure.arrived is not None
                    row[figure.sent], row[figure.arrived] = 40, 40 - int(random[column.name].integers(0, 9))
                    row[column.name] = 1 - int(row[figure.arrived]) / 40
            if "probe.level" in row:
                row["probe.level"] = float(level_dbm - plan.distance_m + random["probe.level"].normal(0, 2))
            for step in ("p502", "p8192"):
                if f"{step}.rtt_payload_bytes" in row:
                    row[f"{step}.rtt_payload_bytes"] = int(step.removeprefix("p"))
            row |= {
                "schema_version": columns.SCHEMA_VERSION,
                "trial": plan.trial,
                "procedure": plan.procedure.name,
                "scenario": str(plan.procedure.scenario),
                "topology": str(plan.topology),
                "backend": plan.backend,
                "distance": plan.distance,
                "distance_m": plan.distance_m,
                "protocol": str(protocol),
                "repeat": number,
                "attempt": 1,
                "status": "valid",
                "started_utc_ns": 1_795_309_790_492_337_123 + number,
                "profiles_sha256": plan.profiles_sha256,
                "procedure_sha256": plan.procedure_sha256,
                "code_sha256": plan.code_sha256,
            }
            table.append(row)
    return table


def _value(column: Column, random: np.random.Generator) -> Value:
    if column.type is str:
        return ["calm", "gusts"][int(random.integers(0, 2))] if column.name == "wind" else "v1"
    if column.type is bool:
        return bool(random.integers(0, 4))
    if column.type is int:
        return int(random.integers(1, 9))
    low, high = column.possible_range
    scale = {"s": 0.01, "bit/s": 4e6, "V": 7.4}.get(column.unit, 0.1)
    return float(np.clip(random.lognormal(0, 0.2) * scale, low, high))
