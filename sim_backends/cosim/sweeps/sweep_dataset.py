"""Writes the results of a sweep as a dataset of Parquet files, with a folder per value of each factor (Hive style).

Equal results give equal bytes: rows are in the order of the plan, not in the order in which the runs ended.
"""

import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from typing import Final
from urllib.parse import quote

import pyarrow as pa
import pyarrow.parquet

from fieldkit.core import files
from fieldkit.core.columns import SCHEMA_VERSION, Kind, Value
from sim_backends.cosim.commands.flow_rows import scenario_hashes
from sim_backends.cosim.sweeps.factors import Factor
from sim_backends.cosim.sweeps.sweep_folder import SweepFolder
from sim_backends.cosim.sweeps.sweep_plan import SweepPlan, SweepSetting

_SWEEP_COLUMNS: Final[Mapping[str, Mapping[str, str]]] = {
    "flow": {"unit": "text", "meaning": "Stream of packets and its receiver."},
    "added_delay_mean_s": {
        "unit": "s",
        "meaning": "Mean delay that the sync policy added to packets that arrived.",
        "label": "added delay, mean",
        "kind": Kind.MEAN,
    },
    "exchanges_per_s": {
        "unit": "1/s",
        "meaning": "Exchanges of physics and network per simulated second.",
        "label": "exchanges per second",
        "kind": Kind.MEAN,
    },
}
"""Declarations of the columns that trials do not have."""


def write_dataset(plan: SweepPlan, folder: SweepFolder) -> int:
    """Replace the dataset of a sweep by a dataset of the results so far, and return the number of its rows.

    Raises:
        ConfigurationError: The new dataset cannot be written; an existing dataset is unchanged.
        EvidenceError: The file of a run is damaged.
    """
    rows = {setting.digest: _rows_of(setting, plan, folder) for setting in plan.settings}
    partitions = [factor.column for factor in plan.factors]
    schema = _schema((row for setting_rows in rows.values() for row in setting_rows), plan.factors)
    new_folder, previous_folder = (folder.path / f".{folder.results.name}.{suffix}" for suffix in ("new", "old"))
    with folder.error_conversion():
        for old_folder in (new_folder, previous_folder):
            shutil.rmtree(old_folder, ignore_errors=True)
        for setting in plan.settings:
            if rows[setting.digest]:
                parts = [
                    f"{column}={quote(value, safe='')}"
                    for column, value in zip(partitions, setting.values.values(), strict=True)
                ]
                path = new_folder.joinpath(*parts, "part-0.parquet")
                path.parent.mkdir(parents=True)
                table = pa.Table.from_pylist(rows[setting.digest], schema=schema)
                pa.parquet.write_table(table, path, compression="zstd")
        new_folder.mkdir(exist_ok=True)
        paths = sorted(new_folder.rglob("*"))
        files.sync([path for path in paths if path.is_file()])
        for path in (new_folder, *(path for path in paths if path.is_dir())):
            files.sync_folder(path)
        if folder.results.exists():
            folder.results.rename(previous_folder)
        new_folder.rename(folder.results)
        files.sync_folder(folder.path)
        shutil.rmtree(previous_folder, ignore_errors=True)
    return sum(map(len, rows.values()))


def _rows_of(setting: SweepSetting, plan: SweepPlan, folder: SweepFolder) -> list[dict[str, Value]]:
    """Return the rows of all runs of a setting, with the values of factors that are numbers (`Factor.numbers`)."""
    numbers: dict[str, Value] = {}
    for factor in plan.factors:
        if (number_column := factor.numbers) is not None:
            name, _, values = number_column
            numbers[name] = values[factor.values.index(setting.values[factor.name])]
    runs = (run for run in plan.runs if run.setting is setting)
    hashes = scenario_hashes(plan.scenario)  # one for all settings: factors do not count as part of the procedure
    return [numbers | dict(row) | hashes for run in runs for row in folder.rows(run)]


def _schema(rows: Iterable[Mapping[str, Value]], factors: Sequence[Factor]) -> pa.Schema:
    """Return the schema of all files, without the columns that are folders of the dataset."""
    types: dict[str, set[type]] = {}
    for row in rows:
        for name, value in row.items():
            types.setdefault(name, set()).add(type(value))
    declarations = dict(_SWEEP_COLUMNS)
    group_columns, partitions = [], {}
    for factor in factors:
        meaning = f"Value of the setting {factor.name}, as given on the command line."
        partitions[factor.column] = meaning
        if (number_column := factor.numbers) is None:
            group_columns.append(factor.column)
        else:
            name, unit, _ = number_column
            declarations[name] = {
                "unit": unit,
                "meaning": meaning.replace("as given on the command line", "as a number"),
            }
            group_columns.append(name)
    fields = [
        pa.field(name, _arrow_type(column_type), metadata=declarations.get(name))
        for name, column_type in types.items()
        if name not in partitions
    ]
    # `partitions`: the columns that are folders, with their meanings. `by`: the columns that identify a condition.
    metadata = {
        "fieldkit_version": version("fieldkit"),
        "schema_version": str(SCHEMA_VERSION),
        "partitions": json.dumps(partitions),
        "by": json.dumps(["flow", *group_columns]),
    }
    return pa.schema(fields, metadata=metadata)


def _arrow_type(types: set[type]) -> pa.DataType:
    if types == {bool}:
        return pa.bool_()
    if types == {int}:
        return pa.int64()
    return pa.float64() if types <= {int, float} else pa.string()
