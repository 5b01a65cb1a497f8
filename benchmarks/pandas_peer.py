"""Aggregation with pandas and scipy, as a researcher would write it; only the list of quantities is from fieldkit.

`python -m benchmarks.pandas_peer FOLDER` prints the result as JSON.
"""

import json
import sys
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from scipy import stats

from fieldkit.analysis.quantities import DEFAULT_BY, quantities
from fieldkit.core.columns import Kind
from fieldkit.trial.columns import trial_columns

RESAMPLES: Final = 999
"""A tenth of scipy's default, which would take ten times as long."""


def main() -> None:
    """Print mean, median, 95th percentile and a bootstrap interval of every quantity under every condition."""
    tables = sorted(Path(sys.argv[1]).glob("*/trial.csv"))
    rows = pd.concat([pd.read_csv(path, dtype={"distance_m": float}) for path in tables], ignore_index=True)
    results = []
    for key, cell in rows[rows["status"] == "valid"].groupby(list(DEFAULT_BY)):
        for quantity in quantities(trial_columns()):
            values = cell[quantity.name].dropna().to_numpy(dtype=float)
            statistic = np.median if quantity.kind is Kind.MEDIAN else np.mean
            interval = stats.bootstrap(
                (values,), statistic, n_resamples=RESAMPLES, method="percentile", rng=1
            ).confidence_interval
            figures = values.mean(), np.median(values), np.percentile(values, 95), interval.low, interval.high
            results.append([list(map(str, key)), quantity.name, len(values), *map(float, figures)])
    print(json.dumps(results))


if __name__ == "__main__":
    main()
