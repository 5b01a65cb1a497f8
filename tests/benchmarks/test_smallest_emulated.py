"""Every benchmark on namespaces or emulated robots runs at its smallest size; some run only in `make nightly`."""

from pathlib import Path

import pytest

from tests.helpers.nightly import mark_nightly
from tests.helpers.smallest import CASES, run_minimally

pytestmark = pytest.mark.emulated

ON_NAMESPACES = ("layers", "medium", "medium_cost", "moves", "swarm", "tcp_vs_kernel")
ON_ROBOTS = (
    "emane",
    "stop",
    "studies.field_shape",
    "studies.mesh",
    "studies.mesh_losses",
    "studies.middleware",
    "studies.zenoh_images",
    "trial_overhead",
)
ON_LOOPBACK = ("bridge",)
ONLY_NIGHTLY = {"medium", "studies.mesh", "studies.middleware", "studies.zenoh_images", "trial_overhead"}
"""CI runs similar benchmarks: `medium_cost`, `studies.mesh_losses`, `studies.field_shape` and `stop`."""
IN_CI = {*ON_NAMESPACES, *ON_LOOPBACK, *ON_ROBOTS} - ONLY_NIGHTLY


# pytest-xdist runs the tests of a class in one process; two classes distribute the work.
class TestOnNamespaces:
    @pytest.mark.parametrize("name", mark_nightly(ON_NAMESPACES + ON_LOOPBACK, in_ci=IN_CI))
    def test_a_benchmark_runs_at_its_smallest_size(self, name: str, tmp_path: Path) -> None:
        run_minimally(name, tmp_path)


class TestOnRobots:
    @pytest.mark.parametrize("name", mark_nightly(ON_ROBOTS, in_ci=IN_CI))
    def test_a_benchmark_runs_at_its_smallest_size(self, name: str, tmp_path: Path) -> None:
        run_minimally(name, tmp_path)


def test_every_emulated_benchmark_runs() -> None:
    assert {name for name, case in CASES.items() if case.emulated} == {*ON_NAMESPACES, *ON_LOOPBACK, *ON_ROBOTS}
