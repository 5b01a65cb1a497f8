"""Sweeps: their settings, their state on disk, and their dataset for fieldkit and other programs."""

import csv
import errno
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import fieldkit
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, EvidenceError, LinkError
from sim_backends.cosim.commands.execution import simulate
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.sweeps import sweep_runner
from sim_backends.cosim.sweeps.factors import load_combinations, parse_factors
from tests.helpers.runs import run_here
from tests.helpers.task_workers import PAIR

SWEEP = (
    "cosim",
    "sweep",
    "pair.yaml",
    "--over",
    "policy=sliding_window,scheduled",
    "window=7ms,13ms",
    "--seeds",
    "2",
)
RUNS = 8


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished sweep."""
    folder = tmp_path_factory.mktemp("lab")
    (folder / "pair.yaml").write_text(PAIR, encoding="utf-8")
    result = run_here(folder, *SWEEP, "--jobs", "1", "-o", "sweep")
    assert (result.code, f"{RUNS} runs: 4 settings with 2 seeds" in result.out) == (0, True), result.err
    return folder


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("polcy=scheduled", "did you mean 'policy'"),
        ("policy=schedule", "did you mean 'scheduled'"),
        ("window=1xs", "unknown unit 'xs'"),
        ("radio.exponnt=2", "did you mean 'exponent'"),
        ("agents.husky-9.along=1m", "did you mean 'agents.husky-"),
        ("window=1ms,1ms", "has the same value twice"),
        ("window=1ms,0.001s", "are the same setting: window=1ms; and window=0.001s"),
        ("window", "is not NAME=VALUE"),
        ("window=1ms\nname: x", "is more than one value"),
        ("distance=20kg", "unit 'kg'"),
    ],
)
def test_a_wrong_setting_is_refused_before_any_run(overrides: str, message: str, tmp_path: Path) -> None:
    result = run_here(tmp_path, "cosim", "sweep", "baylands", "--over", overrides, "-o", "out")
    assert result.code == 2
    assert message in result.err
    assert not (tmp_path / "out").exists()


def positions_by_setting(scenario: str, *overrides: str) -> list[Mapping[str, float | None]]:
    """Return the positions of agents along the line in each setting."""

    def along_m(setting: CosimScenario) -> dict[str, float | None]:
        return {name: plan.along for name, plan in setting.agents.items()}

    return [along_m(setting) for _, setting in load_combinations(scenario, parse_factors(overrides), {})]


def test_a_distance_moves_the_agents_on_the_line() -> None:
    assert positions_by_setting("baylands", "distance=30m,40m") == [
        {"husky-1": 0, "husky-2": 30, "iris": 30},
        {"husky-1": 0, "husky-2": 40, "iris": 40},
    ]
    assert positions_by_setting("field_30ft", "distance=10m") == [{"sender": 0, "receiver": 20, "drone": 10}]
    with pytest.raises(ConfigurationError, match="distance needs a first flow"):
        positions_by_setting("convoy", "distance=10m")


def test_a_list_is_one_value() -> None:
    (factor,) = parse_factors(["agents.a.at_m=[1,2],[3,4]"])
    assert (factor.values, factor.column) == (("[1,2]", "[3,4]"), "agents_a_at_m")


def test_a_failed_run_states_its_reason_and_is_tried_a_limited_number_of_times(
    lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []

    def simulate_or_fail(scenario: CosimScenario, policy: str, seed: int, folder: None) -> Any:  # noqa: ANN401 (as simulate)
        calls.append(seed)
        if seed == 2 and policy == "scheduled":
            raise LinkError("no answer", where="network", remedy="start it")
        return simulate(scenario, policy, seed, folder)

    arguments = (*SWEEP, "--jobs", "1", "-o", "failing")
    with monkeypatch.context() as patch:
        patch.setattr(sweep_runner, "simulate", simulate_or_fail)
        result = run_here(lab, *arguments)
        assert (result.code, len(calls)) == (3, RUNS + 2 * 2)
        assert "2 of 8 runs failed; the first, after 3 attempts: network: no answer" in result.err
        assert f"start it; to try them again: fieldkit {' '.join(SWEEP[:6])}" in result.err
        failures = [json.loads(path.read_text()) for path in (lab / "failing" / "failed").iterdir()]
        assert {(failure["attempts"], failure["reason"]) for failure in failures} == {(3, "network: no answer")}
        assert run_here(lab, *arguments).code == 3
        assert len(calls) == RUNS + 2 * 2, "no attempt remains"
    assert run_here(lab, *arguments, "--again").code == 0
    assert not list((lab / "failing" / "failed").iterdir())
    assert dataset(lab / "failing") == dataset(lab / "sweep")


def test_event_of_a_repeated_run_has_the_number_of_its_attempt(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []

    def fail_first(scenario: CosimScenario, policy: str, seed: int, folder: None) -> Any:  # noqa: ANN401 (as simulate)
        calls.append(seed)
        if len(calls) == 1:
            raise LinkError("no answer", where="network", remedy="start it")
        return simulate(scenario, policy, seed, folder)

    monkeypatch.setattr(sweep_runner, "simulate", fail_first)
    result = run_here(lab, *SWEEP[:4], "policy=scheduled", "--seeds", "1", "--jobs", "1", "--json", "-o", "repeated")
    events = [json.loads(line) for line in result.out.splitlines()]
    ends = [(event["attempt"], bool(event["reason"])) for event in events if event["event"] == "sweep_run_ended"]
    assert ends == [(1, True), (2, False)]


@pytest.mark.parametrize("error", [EvidenceError("no such flow"), ValueError("a defect"), ConfigurationError("bad")])
def test_a_failure_that_would_occur_again_is_tried_once(
    lab: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: Exception
) -> None:
    calls: list[int] = []

    def simulate_or_fail(scenario: CosimScenario, policy: str, seed: int, folder: None) -> Any:  # noqa: ANN401 (as simulate)
        calls.append(seed)
        if seed == 2:
            raise error
        return simulate(scenario, policy, seed, folder)

    monkeypatch.setattr(sweep_runner, "simulate", simulate_or_fail)
    arguments = (*SWEEP, "--jobs", "1", "-o", str(tmp_path / "once"))
    for _ in range(2):
        result = run_here(lab, *arguments)
        assert (result.code, str(error) in result.err) == (getattr(error, "exit_code", 1), True)
    if isinstance(error, ConfigurationError):
        assert calls == [1, 2, 2], "it is an error of the worker, which ends the sweep"
    else:
        assert len(calls) == RUNS
        assert "4 of 8 runs failed; the first, after 1 attempt:" in result.err


def dataset(folder: Path) -> dict[str, bytes]:
    """Return the bytes of each file of a sweep's dataset."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.glob("results/**/*.parquet")}


def test_a_full_disk_is_reported_once_and_no_finished_run_is_lost(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = (*SWEEP, "--jobs", "1", "-o", "full")
    write, written_paths = files.write, list[Path]()

    def write_until_full(path: Path, content: bytes) -> None:
        if len(written_paths) == 4:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write(path, content)
        written_paths.append(path)

    with monkeypatch.context() as patch:
        patch.setattr(files, "write", write_until_full)
        result = run_here(lab, *arguments)
    assert (result.code, result.err.count("error:")) == (2, 1)
    assert "No space left on device" in result.err
    assert "then continue: fieldkit cosim sweep pair.yaml" in result.err
    assert len(list((lab / "full" / "runs").iterdir())) == 3  # the first file is sweep.json
    result = run_here(lab, *arguments)
    assert (result.code, "3 are done" in result.out) == (0, True)
    assert dataset(lab / "full") == dataset(lab / "sweep")


def test_another_sweep_is_refused(lab: Path) -> None:
    result = run_here(lab, *SWEEP[:4], "policy=scheduled", "-o", "sweep")
    assert (result.code, "this is a sweep with other factors" in result.err) == (2, True)


def test_a_damaged_plan_has_a_remedy_that_works(tmp_path: Path) -> None:
    (tmp_path / "pair.yaml").write_text(PAIR, encoding="utf-8")
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep" / "sweep.json").write_text("{", encoding="utf-8")
    result = run_here(tmp_path, *SWEEP, "-o", "sweep")
    assert result.code == EvidenceError.exit_code
    # A sweep without its plan is refused, so the plan must not be deleted.
    assert "restore it from a copy, or choose another -o" in result.err


def test_pandas_polars_and_duckdb_read_the_dataset(lab: Path) -> None:
    import duckdb  # noqa: PLC0415 (these take 0.3 s, which each worker would need at its start)
    import pandas as pd  # noqa: PLC0415
    import polars as pl  # noqa: PLC0415

    results = lab / "sweep" / "results"
    expected = {("scheduled", "7ms"): 2, ("scheduled", "13ms"): 2, ("sliding_window", "7ms"): 2}
    expected |= {("sliding_window", "13ms"): 2}
    frame = pd.read_parquet(results)
    assert frame.groupby(["policy", "window"], observed=True).size().to_dict() == expected
    counts = pl.read_parquet(results, hive_partitioning=True).group_by("policy", "window").len()
    assert {(row[0], row[1]): row[2] for row in counts.iter_rows()} == expected
    query = f"SELECT policy, \"window\", count(*) FROM '{results}/**/*.parquet' GROUP BY ALL"
    rows: Any = duckdb.sql(query)
    assert {(row[0], row[1]): row[2] for row in rows.fetchall()} == expected


def test_aggregate_compare_and_load_read_the_folder_like_trials(lab: Path) -> None:
    result = run_here(lab, "aggregate", "sweep", "--quantity", "added_delay_mean_s", "--format", "csv")
    cells = list(csv.DictReader(result.out.splitlines()))
    assert (result.code, result.err, len(cells)) == (0, "", 4)
    conditions = {(cell["flow"], cell["policy"], cell["window_s"], cell["n_valid"]) for cell in cells}
    assert ("pose/b", "scheduled", "0.013", "2") in conditions
    cell = fieldkit.load(lab / "sweep").cell(policy="scheduled", window="13ms")
    assert cell.n_valid == 2
    assert 0.003 < cell["added_delay_mean_s"].value < 0.013
    comparison = run_here(lab, "compare", "sweep", "sweep", "--format", "csv")
    assert comparison.code == 0, comparison.err
    assert {float(row["difference"] or 0) for row in csv.DictReader(comparison.out.splitlines())} == {0}


def test_two_settings_of_a_sweep_are_compared(lab: Path) -> None:
    between = ("--between", "policy=sliding_window,scheduled")
    result = run_here(lab, "compare", "sweep", *between, "--format", "csv")
    assert result.code == 0, result.err
    rows = list(csv.DictReader(result.out.splitlines()))
    assert {(row["flow"], row["window_s"], row["n_a"], row["n_b"]) for row in rows} == {
        ("pose/b", "0.007", "2", "2"),
        ("pose/b", "0.013", "2", "2"),
    }
    cells = {
        policy: fieldkit.load(lab / "sweep").cell(policy=policy, window="13ms")["added_delay_mean_s"].value
        for policy in ("sliding_window", "scheduled")
    }
    (difference,) = (
        float(row["difference"])
        for row in rows
        if row["quantity"] == "added_delay_mean_s" and row["window_s"] == "0.013"
    )
    assert difference == pytest.approx(cells["scheduled"] - cells["sliding_window"], rel=1e-6)
    filtered_result = run_here(lab, "compare", "sweep", *between, "--where", "window_s == 0.013", "--format", "csv")
    assert filtered_result.code == 0, filtered_result.err
    assert {row["window_s"] for row in csv.DictReader(filtered_result.out.splitlines())} == {"0.013"}


@pytest.mark.parametrize("between", ["window=7ms,13ms", "window_s=0.007,0.013"])
def test_two_values_with_units_are_compared_in_both_forms(lab: Path, between: str) -> None:
    result = run_here(lab, "compare", "sweep", "--between", between, "--format", "csv")
    assert result.code == 0, result.err
    rows = list(csv.DictReader(result.out.splitlines()))
    assert {(row["flow"], row["policy"], row["n_a"], row["n_b"]) for row in rows} == {
        ("pose/b", "scheduled", "2", "2"),
        ("pose/b", "sliding_window", "2", "2"),
    }


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "compare needs two runs"),
        (("--between", "policy=sliding_window"), "write two values"),
        (("--between", "policy=scheduled,scheduled"), "two different values"),
        (("--between", "policy=scheduled,slidingwindow"), "did you mean 'sliding_window'"),
        (("--between", "polcy=a,b"), "did you mean 'policy'"),
    ],
)
def test_a_wrong_comparison_of_two_settings_is_explained(lab: Path, options: tuple[str, ...], message: str) -> None:
    result = run_here(lab, "compare", "sweep", *options)
    assert (result.code, message in result.err) == (2, True), result.err


def test_a_report_of_many_settings_has_heat_maps_in_the_order_of_numbers(lab: Path) -> None:
    factors = ("radio.loss=20%,0%,10%,5%", "window=13ms,7ms")
    command = ("cosim", "sweep", "pair.yaml", "--set", "policy.name=scheduled", "--over", *factors, "--seeds", "1")
    assert run_here(lab, *command, "--jobs", "1", "-o", "many").code == 0
    result = run_here(lab, "report", "many", "-o", "many.html")
    assert result.code == 0, result.err
    page = (lab / "many.html").read_text(encoding="utf-8")
    assert "<h1>Sweep over radio_loss and window</h1>" in page
    assert 'id="map-added_delay_mean_s"' in page
    (label,) = re.findall(r'aria-label="added delay, mean, pose/b[^"]*"', page)  # for screen readers
    cells = [(loss, window) for window in ("7ms", "13ms") for loss in ("0%", "5%", "10%", "20%")]
    assert re.findall(r"radio_loss (\S+), window (\S+): \d", label) == cells
    assert "Figures with a line or a strip per setting are left out" in page
    assert 'id="strips"' not in page
    aggregation = run_here(lab, "aggregate", "many", "--quantity", "byte_loss", "--format", "csv")
    values = [row["radio_loss_value"] for row in csv.DictReader(aggregation.out.splitlines())]
    assert values == [value for value in ("0", "0.05", "0.1", "0.2") for _ in range(2)]


def test_factors_with_units_are_numbers() -> None:
    factor_texts = [
        "radio.loss=2%,10%",
        "traffic.0.rate=1kHz,10Hz",
        "radio.tx_power=-3dBm,20dBm",
        "agents.a.along=-5m,5m",
    ]
    loss, rate, power, along = parse_factors(factor_texts)
    assert loss.numbers == ("radio_loss_value", "1", (0.02, 0.1))
    assert rate.numbers == ("traffic_0_rate_hz", "Hz", (1000, 10))
    assert power.numbers == ("radio_tx_power_dbm", "dBm", (-3, 20))
    assert along.numbers is None, "the value of a column in metres is not negative"


def test_a_setting_under_two_names_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="window and window are the same setting"):
        parse_factors(["policy.window=1ms", "window=2ms"])


@pytest.mark.parametrize("text", ["1.2.3", "224.1.2.8", "."])
def test_a_text_of_digits_and_points_is_no_number(text: str) -> None:
    (factor,) = parse_factors([f"network.options.version={text}"])
    assert factor.numbers is None


def test_a_factor_that_another_option_sets_is_refused(tmp_path: Path) -> None:
    words = ("cosim", "sweep", "baylands", "--duration", "1s", "--over", "duration=1s,2s", "-o", "out")
    result = run_here(tmp_path, *words)
    assert (result.code, "--over: another option sets duration to 1s" in result.err) == (2, True), result.err
