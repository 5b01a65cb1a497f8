"""Every benchmark runs at its smallest size (see `tests/helpers/smallest.py`); a few run only in `make nightly`."""

from importlib import import_module
from pathlib import Path

import pytest

from tests.helpers.nightly import mark_nightly
from tests.helpers.paths import ROOT
from tests.helpers.smallest import CASES, run_minimally

NOT_EMULATED = [name for name, case in CASES.items() if not case.emulated]
ONLY_NIGHTLY = {"archive", "high_throughput_vs_ns3", "sweep", "tcp_vs_ns3"}
"""CI runs similar benchmarks: `aggregate`, `radio_vs_ns3`, `studies.combinations` and `cosim_vs_ns3`."""

NOT_RUN = {
    "firmware_flights": "needs simulated firmware, not available in CI; test_firmware_flights.py tests its rows",
    "ns3_versions": "downloads 1 GB per version of ns-3, and compiles with each",
    "studies.gallery": "run by tests/e2e/test_gallery.py",
}
"""Benchmarks that need more than CI has, with the reason and their tests. Here only their help is printed."""

SUPPORT_MODULES = {
    "archive_peers",
    "archive_trials",
    "bash_peer",
    "cosim_peers",
    "experiment_packets",
    "footprint",
    "kernel_minstrel",
    "kernel_recordings",
    "kernel_roaming",
    "lifetimes",
    "mujoco_fleet",
    "namespaces",
    "overhead",
    "pandas_peer",
    "roaming_lab",
    "roaming_recordings",
    "slow_links",
} | {
    "studies.middleware_cells",
    "studies.middleware_table",
    "studies.zenoh_plain",
}
"""Modules that other benchmarks import or start."""


@pytest.mark.parametrize("name", mark_nightly(NOT_EMULATED, in_ci=set(NOT_EMULATED) - ONLY_NIGHTLY))
def test_a_benchmark_runs_at_its_smallest_size(name: str, tmp_path: Path) -> None:
    run_minimally(name, tmp_path)


@pytest.mark.parametrize("name", NOT_RUN)
def test_a_benchmark_that_does_not_run_here_prints_its_help(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", [name, "--help"])
    with pytest.raises(SystemExit) as error_info:
        import_module(f"benchmarks.{name}").main()
    assert error_info.value.code == 0
    assert "usage:" in capsys.readouterr().out


def test_every_module_runs_or_is_used_by_others() -> None:
    modules = {path.stem for path in (ROOT / "benchmarks").glob("*.py")}
    modules |= {f"studies.{path.stem}" for path in (ROOT / "benchmarks" / "studies").glob("*.py")}
    assert set(CASES) | set(NOT_RUN) | SUPPORT_MODULES == modules
    texts = [
        path.read_text(encoding="utf-8")
        for folder in ("benchmarks", "tests")
        for path in (ROOT / folder).rglob("*.py")
    ]
    for name in SUPPORT_MODULES:
        assert sum(name.split(".")[-1] in text for text in texts) > 1, f"nothing uses benchmarks.{name}"
