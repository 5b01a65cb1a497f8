"""`fieldkit cosim shootout` on the command line."""

import json
import re
from pathlib import Path

import pytest

from tests.e2e.test_cosim_run import SCENARIO, cosim, rows

POLICIES = (
    "event_driven",
    "variable_stepped",
    "time_stepped",
    "scheduled",
    "sliding_window",
    "velocity_aware_raw",
    "velocity_aware",
    "error_bounded",
)
LOSSY = "radio.loss=20%"


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    (tmp_path / "pass.yaml").write_text(SCENARIO.replace("2s", "500ms"), encoding="utf-8")
    return tmp_path


def test_every_policy_has_a_row_and_exact_policies_have_no_error(lab: Path) -> None:
    run = cosim(lab, "shootout", "pass.yaml", "--format", "csv", "--seeds", "2")
    assert run.code == 0, run.err
    rows_by_policy = {row["policy"]: row for row in rows(run.out)}
    assert tuple(rows_by_policy) == POLICIES
    for policy in POLICIES[:2]:
        exact = {name: float(value) for name, value in rows_by_policy[policy].items() if "error" in name}
        # Positions are known only at the steps of the physics.
        position_errors_m = [exact.pop(f"position_error_{statistic}_m") for statistic in ("mean", "p95", "max")]
        assert set(exact.values()) == {0.0}
        assert 0 < position_errors_m[0] <= position_errors_m[2] <= 1.0 * 0.001 + 1e-9, "1 m/s for a step of 1 ms"
    # An arrival waits for the end of its window, which takes half a window on average.
    assert 0 < float(rows_by_policy["scheduled"]["delivery_error_mean_s"]) <= 0.010
    assert float(rows_by_policy["scheduled"]["exchanges_per_s"]) == pytest.approx(100)
    assert int(float(rows_by_policy["sliding_window"]["causality_violations"])) > 0
    assert float(rows_by_policy["sliding_window"]["position_error_max_m"]) <= 1.0 * 0.010 + 1e-9, "1 m/s for a window"


def test_numbers_are_reproducible_except_for_wall_time(lab: Path) -> None:
    def numbers() -> list[dict[str, str]]:
        rows_by_policy = json.loads(
            cosim(lab, "shootout", "pass.yaml", "--duration", "100ms", "--format", "json").out
        )
        timed = re.compile("wall|real_time")
        return [{name: value for name, value in row.items() if not timed.match(name)} for row in rows_by_policy]

    assert numbers() == numbers()


def test_the_table_explains_its_columns_within_100_characters(lab: Path) -> None:
    run = cosim(lab, "shootout", "pass.yaml", "--duration", "100ms", "--window", "10ms,20ms")
    assert run.code == 0, run.err
    assert max(map(len, run.out.splitlines())) <= 100
    for title in ("time (ms)", "p95", "max", "fate (%)", "late", "added", "position (mm)", "per s", "speed"):
        assert title in run.out
        assert f"{title.partition(' (')[0]}: " in " ".join(run.out.split()), "the column is explained"


def test_a_window_commensurate_with_traffic_is_reported_with_a_better_one(lab: Path) -> None:
    """A packet of the stream of 50 Hz is sent every two windows of 10 ms. The proposed window causes no note."""
    options = ("--duration", "400ms", "--policy", "scheduled")
    run = cosim(lab, "shootout", "pass.yaml", *options, "--window", "10ms")
    assert run.code == 0, run.err
    report = " ".join(run.err.split())
    assert "the window of 10 ms is commensurate with" in report
    assert "(every 20 ms: 1 phase)" in report
    proposal = re.search(r"use --window (\d+ms), or --seeds 20", report)
    assert proposal, report
    assert "commensurate" not in cosim(lab, "shootout", "pass.yaml", *options, "--window", proposal[1]).err


def test_the_figure_names_every_policy_and_is_reproducible(lab: Path) -> None:
    for name in ("one.svg", "two.svg"):
        run = cosim(lab, "shootout", "pass.yaml", "--duration", "100ms", "--window", "10ms,20ms", "--figure", name)
        assert run.code == 0, run.err
    figure = (lab / "one.svg").read_text(encoding="utf-8")
    assert figure == (lab / "two.svg").read_text(encoding="utf-8")
    for policy in POLICIES:
        assert policy in figure


def test_orders_are_reported_for_any_transport(lab: Path) -> None:
    """A sampled arrival waits for half of its window on average, so the error is of first order."""
    path = lab / "pass.yaml"
    tcp = "  - {kind: stream, name: map, from: bob, to: ann, protocol: tcp, rate: 10Hz, size_bytes: 20000}\n"
    path.write_text(path.read_text(encoding="utf-8") + tcp, encoding="utf-8")
    options = ("--orders", "--duration", "500ms", "--policy", "scheduled", "--window", "10ms,40ms")
    run = cosim(lab, "shootout", "pass.yaml", *options, "--figure", "o.svg")
    assert run.code == 0, run.err
    rows_by_policy = re.search(r"^ scheduled +(\d\.\d+) \[", run.out, re.MULTILINE)
    assert rows_by_policy, run.out
    assert float(rows_by_policy[1]) == pytest.approx(1, abs=0.5)
    assert f"order {rows_by_policy[1]}" in (lab / "o.svg").read_text(encoding="utf-8")


def test_the_bias_of_a_sampled_network_is_half_a_window_of_delay(lab: Path) -> None:
    options = ("--bias", "--seeds", "3", "--policy", "scheduled", "--window", "50ms,20ms", "--figure", "b.svg")
    run = cosim(lab, "shootout", "pass.yaml", *options, "--format", "csv")
    assert run.code == 0, run.err
    (delay,) = [row for row in rows(run.out) if row["measure"] == "delay_s"]
    # With a period of 20 ms each seed has one phase in the window: 0 to 20 ms, 10 on average.
    assert 0 < float(delay["bias"]) < 0.02
    assert float(delay["bias_low"]) < float(delay["bias"]) < float(delay["bias_high"])
    assert "--bias uses only the shortest window of --window, 20 ms" in run.err
    assert "bias of delay (ms)" in (lab / "b.svg").read_text(encoding="utf-8")


def test_followers_are_reported_with_their_distance_from_the_reference_path(lab: Path) -> None:
    options = ("--duration", "1s", "--policy", "event_driven", "--policy", "time_stepped", "--window", "70ms")
    run = cosim(lab, "shootout", "convoy", *options, "--format", "markdown", "--figure", "c.svg")
    assert run.code == 0, run.err
    exact, delayed = re.findall(
        r"^\| (?:event_driven|time_stepped) \| ([\d.]+ \| [\d.]+) \| [\d.]+ \| [\d.]+ \| ",
        run.out.partition("| spacing (cm)")[2].partition("followers")[0],
        re.MULTILINE,
    )
    assert exact != delayed
    figure = (lab / "c.svg").read_text(encoding="utf-8")
    assert "Distance from the reference's path, 70 ms" in figure.replace("&#x27;", "'")


def test_a_run_reports_the_same_followers_as_its_recording(lab: Path) -> None:
    result = cosim(
        lab, "run", "convoy", "--duration", "1s", "--window", "7ms", "--policy", "scheduled", "--out", "sim"
    )
    assert "spacing (cm)" in result.out
    assert len(list((lab / "sim" / "captures").iterdir())) == 3
    replayed_run = cosim(lab, "replay", "sim")
    assert replayed_run.out.partition("followers\n")[2] == result.out.partition("followers\n")[2], replayed_run.err
    report = json.loads(cosim(lab, "replay", "sim", "--format", "json").out)
    assert report.keys() == {"flows", "followers"}
    (row,) = report["followers"]
    assert f"{100 * row['spacing_mean_m']:.3g}" in result.out.partition("followers\n")[2]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--policy", "event_driven"), "exact policies have no errors in a window"),
        (("--window", "1ms", "--figure", "orders.svg"), "errors against the window need two windows"),
    ],
)
def test_orders_that_cannot_be_computed_or_drawn_are_refused(lab: Path, words: tuple[str, ...], message: str) -> None:
    run = cosim(lab, "shootout", "pass.yaml", "--orders", *words)
    assert (run.code, message in run.err) == (2, True), run.err


def test_the_table_of_a_shootout_can_be_plotted_again(lab: Path) -> None:
    options = ("--policy", "scheduled", "--policy", "time_stepped", "--format", "csv", "--figure", "one.svg")
    table = cosim(lab, "shootout", "pass.yaml", "--window", "5ms,20ms", "--duration", "200ms", *options)
    (lab / "all.csv").write_text(table.out, encoding="utf-8")
    run = cosim(lab, "plot", "all.csv", "--out", "two.svg")
    assert run.code == 0, run.err
    assert (lab / "one.svg").read_text(encoding="utf-8") == (lab / "two.svg").read_text(encoding="utf-8")
    (lab / "all.csv").write_text("\ufeff" + table.out, encoding="utf-8")
    assert cosim(lab, "plot", "all.csv", "--out", "two.svg").code == 0, "a spreadsheet begins a file with this mark"
    head = "policy,exchanges_per_s,delivery_error_mean_s,position_error_mean_m,path_error_max_m\n"
    huge, tiny = (f"{head}scheduled,10,{number},0.1,0.1\n" for number in ("1e400", "1e-320"))
    for text in ("policy,sent\na,1\n", table.out.partition("\n")[0], "\x00", huge, tiny):
        (lab / "all.csv").write_text(text, encoding="utf-8")
        rejected_run = cosim(lab, "plot", "all.csv", "--out", "two.svg")
        assert (rejected_run.code, "--format csv" in rejected_run.err) == (4, True), rejected_run.err


def test_the_cost_of_a_bound_is_reported_with_the_fixed_windows_that_satisfy_it(lab: Path) -> None:
    # The husky drives at 0.9 m/s from the start, 11 mm in 12.5 ms.
    words = ("shootout", "pass.yaml", "--bound", "--seeds", "2", "--duration", "300ms")
    run = cosim(lab, *words, "--format", "csv")
    first, second = rows(run.out)
    for row in (first, second):
        assert float(row["largest_m"]) <= 0.01
        assert 0.01 < float(row["all_window_s"]) <= float(row["found_window_s"]) * 1.0001
        assert float(row["found_factor"]) == pytest.approx(int(row["found_exchanges"]) / int(row["exchanges"]))
        assert float(row["all_factor"]) > 3
    assert first["all_window_s"] == second["all_window_s"]
    report = cosim(lab, *words).out.replace("\n", " ")
    factor = sum(int(row["all_exchanges"]) for row in (first, second)) / sum(
        int(row["exchanges"]) for row in (first, second)
    )
    assert f"{factor:.3g} times as many; the longest windows of the single runs need" in report
    rejected_run = cosim(lab, "shootout", "pass.yaml", "--bound", "--set", "policy.bound_db=1")
    assert (rejected_run.code, "bound_db is a bound on the error of path loss" in rejected_run.err) == (2, True)
    rejected_run = cosim(lab, "shootout", "pass.yaml", "--bound", "--figure", "b.svg")
    assert (rejected_run.code, "has no figure" in rejected_run.err) == (2, True)


def test_the_satisfaction_loop_reports_each_round(lab: Path) -> None:
    rule = ("--policy", "velocity_aware", "--window", "10ms")
    run = cosim(lab, "satisfy", "pass.yaml", *rule, "--threshold", "99%")
    assert run.code == 0, run.err
    assert "is accepted (threshold 99 %)" in run.out
    assert "the loss of the exact reference is" in run.out
    unsatisfied = cosim(
        lab, "satisfy", "pass.yaml", *rule, "--threshold", "0%", "--rounds", "2", "--set", LOSSY, "--format", "csv"
    )
    assert unsatisfied.code == 1, unsatisfied.err
    assert "no round was satisfactory: no loss was accepted in 2 rounds" in unsatisfied.err
    first, second = rows(unsatisfied.out)
    assert float(second["window_s"]) == pytest.approx(float(first["median_window_s"]))
    assert float(second["window_s"]) > 0.01, "bob accelerates, and the rule selects longer windows"
    rejected_run = cosim(lab, "satisfy", "pass.yaml", "--threshold", "101%")
    assert (rejected_run.code, "--threshold 10%" in rejected_run.err) == (2, True)


def test_a_policy_that_finds_no_window_is_reported_and_the_others_continue(lab: Path) -> None:
    run = cosim(
        lab,
        "shootout",
        "pass.yaml",
        "--window",
        "0.5ms",
        "--policy",
        "velocity_aware_raw",
        "--policy",
        "error_bounded",
    )
    assert run.code == 0
    assert "note: velocity_aware_raw 0.5 ms" in run.err
    assert "w + (Vp - Vs)/1000" in run.err
    assert re.search(r"^ velocity_aware_raw +-", run.out, re.MULTILINE)


@pytest.mark.parametrize(
    ("words", "message", "remedy"),
    [
        (("--policy", "slidng_window"), "there is no sync policy 'slidng_window'", "did you mean 'sliding_window'?"),
        (("--window", "1"), "--window '1' has no unit", "1s or 1ms"),
        (("--window", "0ms"), "a window that is not above 0", "--window 1ms,10ms,100ms"),
        (("--bias",), "--bias compares several seeds, but there is only one", "add --seeds 20"),
        (("--figure", "x.jpg"), "--figure: the suffix of 'x.jpg' is unknown", ".svg, .pdf, .png"),
        (("--figure", "none/x.svg"), "none: there is no such folder", "mkdir -p none"),
    ],
)
def test_bad_input_is_reported_with_a_remedy(lab: Path, words: tuple[str, ...], message: str, remedy: str) -> None:
    rejected_run = cosim(lab, "shootout", "pass.yaml", *words)
    assert rejected_run.code == 2, rejected_run.out + rejected_run.err
    assert message in rejected_run.err
    assert remedy in rejected_run.err
    assert not rejected_run.out
