"""Aggregates all `trial.csv` below a folder with pandas or DuckDB, for comparison with `fieldkit aggregate`.

The command `python -m benchmarks.archive_peers NAME FOLDER` prints the result as JSON.

NAME is pandas, duckdb, parquet (DuckDB reads the Parquet file), or write, which writes the Parquet file.
"""

import json
import sys
from pathlib import Path
from typing import Any, Final

BY: Final = ("procedure", "scenario", "topology", "backend", "distance_m", "protocol")
QUANTITY: Final = "rtt_median_s"
PARQUET: Final = "archive.parquet"


def by_pandas(folder: Path) -> list[list[Any]]:
    """Return a row per condition: its values, and the count, mean and median of `QUANTITY`."""
    import pandas as pd  # noqa: PLC0415 (a process imports only the library that it measures)

    tables = sorted(folder.glob("**/trial.csv"))
    rows = pd.concat([pd.read_csv(table, dtype={"distance_m": float}) for table in tables], ignore_index=True)
    rows = rows[(rows["distance_m"] < 20) & (rows["topology"] == "master") & (rows["status"] == "valid")]
    cells = rows.dropna(subset=[QUANTITY]).groupby(list(BY))[QUANTITY].agg(["count", "mean", "median"])
    return [[*key, *map(float, figures)] for key, figures in zip(cells.index, cells.to_numpy(), strict=True)]


def _query(folder: Path, text: str) -> Any:  # noqa: ANN401 (a relation of DuckDB)
    """Return the result of a query; DuckDB writes data that does not fit into memory next to the archive."""
    import duckdb  # noqa: PLC0415 (as above)

    duckdb.execute(f"SET temp_directory = '{folder.parent / 'duckdb'}'")
    return duckdb.sql(text)


def by_duckdb(folder: Path, source: str) -> list[list[Any]]:
    """Return the rows of `by_pandas`, with distances as text, in any order; DuckDB reads them from a table.

    Args:
        folder: The archive.
        source: The table, as in the FROM clause of a query.
    """
    keys = ", ".join(BY)
    query = (
        f"SELECT {keys}, count({QUANTITY}), avg({QUANTITY}), median({QUANTITY}) FROM {source} "
        "WHERE CAST(distance_m AS DOUBLE) < 20 AND topology = 'master' AND status = 'valid' "
        f"AND {QUANTITY} IS NOT NULL GROUP BY {keys}"
    )
    rows = _query(folder, query)
    return [
        [str(float(value)) if name == "distance_m" else value for name, value in zip(BY, row, strict=False)]
        + list(row[len(BY) :])
        for row in rows.fetchall()
    ]


def main() -> None:
    """Print the rows, or write the Parquet file."""
    name, folder = sys.argv[1], Path(sys.argv[2])
    tables = f"read_csv('{folder}/**/trial.csv', union_by_name=true, sample_size=-1)"
    parquet = folder.parent / PARQUET
    if name == "write":
        _query(folder, f"COPY (SELECT * FROM {tables}) TO '{parquet}' (FORMAT parquet)")
    elif name == "pandas":
        print(json.dumps(by_pandas(folder)))
    else:
        print(json.dumps(by_duckdb(folder, tables if name == "duckdb" else f"'{parquet}'")))


if __name__ == "__main__":
    main()
