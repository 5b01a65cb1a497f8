"""Every benchmark on namespaces or emulated robots runs at its smallest size."""

from pathlib import Path

import pytest

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


# pytest-xdist runs the tests of a class in one process; two classes distribute the work.
class TestOnNamespaces:
    @pytest.mark.parametrize("name", ON_NAMESPACES + ON_LOOPBACK)
    def test_a_benchmark_runs_at_its_smallest_size(self, name: str, tmp_path: Path) -> None:
        run_minimally(name, tmp_path)


class TestOnRobots:
    @pytest.mark.parametrize("name", ON_ROBOTS)
    def test_a_benchmark_runs_at_its_smallest_size(self, name: str, tmp_path: Path) -> None:
        run_minimally(name, tmp_path)


def test_every_emulated_benchmark_runs() -> None:
    assert {name for name, case in CASES.items() if case.emulated} == {*ON_NAMESPACES, *ON_LOOPBACK, *ON_ROBOTS}
