"""A pytest plugin that gives the tests of real programs priority for the processors in a run with several workers.

Programs on emulated robots have time limits, for example the lease of a robot that drives. The other tests only
become slower if they wait for a processor.
"""

import os
from collections.abc import Generator, Sequence
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


def interleaved(items: Sequence[pytest.Item]) -> list[pytest.Item]:
    """Return tests so that files with real programs are evenly distributed among the other files.

    Workers take the files in order. If all files with real programs were first, each of their programs would have to
    wait for the programs of all other workers.
    """
    files = [list(file_items) for _, file_items in groupby(items, key=lambda item: item.path)]
    is_real = [any(map(_has_real_programs, file_items)) for file_items in files]
    # A file's position in its group, from 0 to 1.
    seen = {True: 0, False: 0}
    positions = []
    for real in is_real:
        positions.append(seen[real] / is_real.count(real))
        seen[real] += 1
    order = sorted(range(len(files)), key=lambda index: (positions[index], not is_real[index]))
    return [item for index in order for item in files[index]]


def _has_real_programs(item: pytest.Item) -> bool:
    return item.get_closest_marker("emulated") is not None
