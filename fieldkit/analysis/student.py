"""The quantiles that 95 % intervals rest on: the normal one, and Student's for arrays of degrees of freedom."""

import math
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

CONFIDENCE: Final = 0.95
"""Of all intervals."""

NORMAL: Final = NormalDist().inv_cdf((1 + CONFIDENCE) / 2)
"""The normal distribution's 97.5 % quantile, which has as much above it as is missed on one side."""

_ONE: Final = math.tan(math.pi * CONFIDENCE / 2)
_TWO: Final = CONFIDENCE * math.sqrt(2 / (1 - CONFIDENCE**2))
# Abramowitz and Stegun 1964, 26.7.5.
_SERIES: Final = (
    (NORMAL**3 + NORMAL) / 4,
    (5 * NORMAL**5 + 16 * NORMAL**3 + 3 * NORMAL) / 96,
    (3 * NORMAL**7 + 19 * NORMAL**5 + 17 * NORMAL**3 - 15 * NORMAL) / 384,
    (79 * NORMAL**9 + 776 * NORMAL**7 + 1482 * NORMAL**5 - 1920 * NORMAL**3 - 945 * NORMAL) / 92160,
)
_REST: Final = 32 * (_TWO - NORMAL - sum(term / 2**power for power, term in enumerate(_SERIES, 1)))


def student(free: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the 97.5 % quantile of Student's t with `free` degrees of freedom, 1 or at least 2, of any shape.

    Fisher and Cornish's expansion, with a fifth term that makes it exact at 2: right to 2 in 10,000 (scipy's). It
    spares a dependency on scipy, of which nothing else is needed.
    """
    inverse = 1 / np.asarray(free, dtype=np.float64)
    series = NORMAL + inverse * np.polynomial.polynomial.polyval(inverse, (*_SERIES, _REST))
    return np.where(inverse == 1, _ONE, series)
