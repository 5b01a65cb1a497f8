"""A pytest plugin that gives the tests of real programs priority for the processors in a run with several workers.

Programs on emulated robots have time limits, for example the lease of a robot that drives. The other tests only
become slower if they wait for a processor.
"""

import os
from collections import Counter
from collections.abc import Generator
from itertools import groupby
from typing import Final

import pytest

_NICE: Final = 5
"""Nice value of the other tests: each of their processes gets a third of the processor time of a normal process."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Run a test that has no real programs at a lower priority. Only root may restore the normal priority."""
    is_lowered = hasattr(item.config, "workerinput") and os.geteuid() == 0 and not _has_real_programs(item)
    if is_lowered:
        os.setpriority(os.PRIO_PROCESS, 0, _NICE)
    try:
        return (yield)
    finally:
        if is_lowered:
            os.setpriority(os.PRIO_PROCESS, 0, 0)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Distribute the files with real programs evenly among the other files; keep the order of both groups.

    Workers take the files in order. If all files with real programs were first, each of their programs would have to
    wait for the programs of all other workers.
    """
    files = [list(file_items) for _, file_items in groupby(items, key=lambda item: item.path)]
    is_real = [any(map(_has_real_programs, file_items)) for file_items in files]
    totals, counts = Counter(is_real), Counter[bool]()
    positions: list[float] = []
    for real in is_real:
        positions.append(counts[real] / totals[real])  # in the group of this file, from 0 to 1
        counts[real] += 1
    order = sorted(range(len(files)), key=lambda index: (positions[index], not is_real[index]))
    items[:] = [item for index in order for item in files[index]]


def _has_real_programs(item: pytest.Item) -> bool:
    return item.get_closest_marker("emulated") is not None
