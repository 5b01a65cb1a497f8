"""`fieldkit cosim shootout` as a user types it."""

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


def test_every_policy_has_its_row_and_exact_ones_no_error(lab: Path) -> None:
    done = cosim(lab, "shootout", "pass.yaml", "--format", "csv", "--seeds", "2")
    assert done.code == 0, done.err
    found = {row["policy"]: row for row in rows(done.out)}
    assert tuple(found) == POLICIES
    for policy in POLICIES[:2]:
        exact = {name: float(value) for name, value in found[policy].items() if "error" in name}
        # Places are those of the last step of the physics.
        held_m = [exact.pop(f"position_error_{what}_m") for what in ("mean", "p95", "max")]
        assert set(exact.values()) == {0.0}
        assert 0 < held_m[0] <= held_m[2] <= 1.0 * 0.001 + 1e-9, "1 m/s for a step of 1 ms"
    # Half a window of 10 ms, waited for by what arrives anywhere in it.
    assert 0 < float(found["scheduled"]["delivery_error_mean_s"]) <= 0.010
    assert float(found["scheduled"]["exchanges_per_s"]) == pytest.approx(100)
    assert int(float(found["sliding_window"]["causality_violations"])) > 0
    assert float(found["sliding_window"]["position_error_max_m"]) <= 1.0 * 0.010 + 1e-9, "1 m/s for a window"


def test_the_same_numbers_come_twice_but_for_wall_time(lab: Path) -> None:
    def numbers() -> list[dict[str, str]]:
        found = json.loads(cosim(lab, "shootout", "pass.yaml", "--duration", "200ms", "--format", "json").out)
        timed = re.compile("wall|real_time")
        return [{name: value for name, value in row.items() if not timed.match(name)} for row in found]

    assert numbers() == numbers()


def test_the_table_says_what_its_columns_mean_in_100_columns(lab: Path) -> None:
    done = cosim(lab, "shootout", "pass.yaml", "--duration", "100ms", "--window", "2ms,20ms")
    assert done.code == 0, done.err
    assert max(map(len, done.out.splitlines())) <= 100
    for head in ("time (ms)", "p95", "max", "fate (%)", "late", "added", "place (mm)", "per s", "speed"):
        assert head in done.out
        assert f"{head.partition(' (')[0]}: " in " ".join(done.out.split()), "what it means"


def test_a_window_that_is_commensurate_with_traffic_is_reported_with_a_better_one(lab: Path) -> None:
    """The stream of 50 Hz is sent every two windows of 10 ms; the window that is proposed gives no note."""
    options = ("--duration", "400ms", "--policy", "scheduled")
    done = cosim(lab, "shootout", "pass.yaml", *options, "--window", "10ms")
    assert done.code == 0, done.err
    told = " ".join(done.err.split())
    assert "the window of 10 ms is commensurate with" in told
    assert "(every 20 ms: 1 phase)" in told
    proposed = re.search(r"use --window (\d+ms), or --seeds 20", told)
    assert proposed, told
    assert "commensurate" not in cosim(lab, "shootout", "pass.yaml", *options, "--window", proposed[1]).err


def test_the_figure_names_every_policy_and_is_the_same_twice(lab: Path) -> None:
    for name in ("one.svg", "two.svg"):
        done = cosim(lab, "shootout", "pass.yaml", "--duration", "100ms", "--window", "2ms,20ms", "--figure", name)
        assert done.code == 0, done.err
    drawn = (lab / "one.svg").read_text(encoding="utf-8")
    assert drawn == (lab / "two.svg").read_text(encoding="utf-8")
    for policy in POLICIES:
        assert policy in drawn


def test_orders_are_told_of_single_windows_whatever_carries_the_packets(lab: Path) -> None:
    """A sampled arrival waits for half of its window in the mean, by the first order."""
    path = lab / "pass.yaml"
    tcp = "  - {kind: stream, name: map, from: bob, to: ann, protocol: tcp, rate: 10Hz, size_bytes: 20000}\n"
    path.write_text(path.read_text(encoding="utf-8") + tcp, encoding="utf-8")
    options = ("--orders", "--duration", "500ms", "--policy", "scheduled", "--window", "10ms,40ms")
    done = cosim(lab, "shootout", "pass.yaml", *options, "--figure", "o.svg")
    assert done.code == 0, done.err
    found = re.search(r"^ scheduled +(\d\.\d+) \[", done.out, re.MULTILINE)
    assert found, done.out
    assert float(found[1]) == pytest.approx(1, abs=0.5)
    assert f"order {found[1]}" in (lab / "o.svg").read_text(encoding="utf-8")


def test_the_bias_of_a_sampled_network_is_half_a_window_of_delay(lab: Path) -> None:
    options = ("--bias", "--seeds", "3", "--policy", "scheduled", "--window", "20ms", "--figure", "b.svg")
    done = cosim(lab, "shootout", "pass.yaml", *options, "--format", "csv")
    assert done.code == 0, done.err
    (delay,) = [row for row in rows(done.out) if row["measure"] == "delay_s"]
    # With a period of 20 ms each seed has one phase in the window: 0 to 20 ms, 10 in the mean.
    assert 0 < float(delay["bias"]) < 0.02
    assert float(delay["bias_low"]) < float(delay["bias"]) < float(delay["bias_high"])
    assert "bias of delay (ms)" in (lab / "b.svg").read_text(encoding="utf-8")


def test_followers_are_told_with_how_far_they_leave_the_references_way(lab: Path) -> None:
    options = ("--duration", "1s", "--policy", "event_driven", "--policy", "time_stepped", "--window", "70ms")
    done = cosim(lab, "shootout", "convoy", *options, "--format", "markdown", "--figure", "c.svg")
    assert done.code == 0, done.err
    exact, late = re.findall(
        r"^\| (?:event_driven|time_stepped) \| ([\d.]+ \| [\d.]+) \| [\d.]+ \| [\d.]+ \| ",
        done.out.partition("| spacing (cm)")[2].partition("followers")[0],
        re.MULTILINE,
    )
    assert exact != late
    drawn = (lab / "c.svg").read_text(encoding="utf-8")
    assert "Off the reference's path, 70 ms" in drawn.replace("&#x27;", "'")


def test_a_run_tells_of_followers_what_its_recording_tells(lab: Path) -> None:
    ran = cosim(lab, "run", "convoy", "--duration", "1s", "--window", "7ms", "--policy", "scheduled", "--out", "sim")
    assert "spacing (cm)" in ran.out
    assert len(list((lab / "sim" / "captures").iterdir())) == 3
    replayed = cosim(lab, "replay", "sim")
    assert replayed.out.partition("followers\n")[2] == ran.out.partition("followers\n")[2], replayed.err
    told = json.loads(cosim(lab, "replay", "sim", "--format", "json").out)
    assert told.keys() == {"flows", "followers"}
    (row,) = told["followers"]
    assert f"{100 * row['spacing_mean_m']:.3g}" in ran.out.partition("followers\n")[2]


def test_the_table_of_a_shootout_is_drawn_again(lab: Path) -> None:
    options = ("--policy", "scheduled", "--policy", "time_stepped", "--format", "csv", "--figure", "one.svg")
    table = cosim(lab, "shootout", "pass.yaml", "--window", "5ms,20ms", "--duration", "200ms", *options)
    (lab / "all.csv").write_text(table.out, encoding="utf-8")
    done = cosim(lab, "plot", "all.csv", "--out", "two.svg")
    assert done.code == 0, done.err
    assert (lab / "one.svg").read_text(encoding="utf-8") == (lab / "two.svg").read_text(encoding="utf-8")
    for text in ("policy,sent\na,1\n", table.out.partition("\n")[0], "\x00"):
        (lab / "all.csv").write_text(text, encoding="utf-8")
        refused = cosim(lab, "plot", "all.csv", "--out", "two.svg")
        assert (refused.code, "--format csv" in refused.err) == (4, True), refused.err


def test_what_a_bound_costs_is_told_beside_the_fixed_windows_that_keep_it(lab: Path) -> None:
    # From its start on the husky drives at 0.9 m/s, 11 mm in 12.5 ms.
    words = ("shootout", "pass.yaml", "--bound", "--seeds", "2", "--duration", "600ms")
    done = cosim(lab, *words, "--format", "csv")
    one, other = rows(done.out)
    for row in (one, other):
        assert float(row["largest_m"]) <= 0.01
        assert 0.01 < float(row["all_window_s"]) <= float(row["found_window_s"]) * 1.0001
        assert float(row["found_factor"]) == pytest.approx(int(row["found_exchanges"]) / int(row["exchanges"]))
        assert float(row["all_factor"]) > 3
    assert one["all_window_s"] == other["all_window_s"]
    told = cosim(lab, *words).out.replace("\n", " ")
    factor = sum(int(row["all_exchanges"]) for row in (one, other)) / sum(
        int(row["exchanges"]) for row in (one, other)
    )
    assert f"{factor:.3g} times as many; the longest windows of the single runs need" in told
    refused = cosim(lab, "shootout", "pass.yaml", "--bound", "--set", "policy.bound_db=1")
    assert (refused.code, "bound_db is about path loss" in refused.err) == (2, True)
    refused = cosim(lab, "shootout", "pass.yaml", "--bound", "--figure", "b.svg")
    assert (refused.code, "has no figure" in refused.err) == (2, True)


def test_the_satisfaction_loop_is_told_round_by_round(lab: Path) -> None:
    rule = ("--policy", "velocity_aware", "--window", "10ms")
    done = cosim(lab, "satisfy", "pass.yaml", *rule, "--threshold", "99%")
    assert done.code == 0, done.err
    assert "accepted at 99 %" in done.out
    assert "the exact reference loses" in done.out
    never = cosim(
        lab, "satisfy", "pass.yaml", *rule, "--threshold", "0%", "--rounds", "2", "--set", LOSSY, "--format", "csv"
    )
    assert never.code == 1, never.err
    assert "no round was satisfactory: 2 rounds were not enough" in never.err
    one, other = rows(never.out)
    assert float(other["window_s"]) == pytest.approx(float(one["median_window_s"]))
    assert float(other["window_s"]) > 0.01, "bob gathers speed, and the rule takes longer windows"
    refused = cosim(lab, "satisfy", "pass.yaml", "--threshold", "101%")
    assert (refused.code, "--threshold 10%" in refused.err) == (2, True)


def test_a_policy_that_has_no_window_is_told_and_the_others_go_on(lab: Path) -> None:
    done = cosim(
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
    assert done.code == 0
    assert "note: velocity_aware_raw 0.5 ms" in done.err
    assert "w + (Vp - Vs)/1000" in done.err
    assert re.search(r"^ velocity_aware_raw +-", done.out, re.MULTILINE)


@pytest.mark.parametrize(
    ("words", "said", "remedy"),
    [
        (("--policy", "slidng_window"), "there is no sync policy 'slidng_window'", "did you mean 'sliding_window'?"),
        (("--window", "1"), "duration '1' has no unit", "1s or 1ms"),
        (("--window", "0ms"), "a window that is not above 0", "--window 1ms,10ms,100ms"),
        (("--bias",), "--bias: one seed has no distribution", "add --seeds 20"),
        (("--figure", "x.jpg"), "--figure: 'x.jpg' has no known format", ".svg, .pdf, .png"),
        (("--figure", "none/x.svg"), "none: there is no such folder", "mkdir -p none"),
    ],
)
def test_bad_input_is_told_with_a_remedy(lab: Path, words: tuple[str, ...], said: str, remedy: str) -> None:
    refused = cosim(lab, "shootout", "pass.yaml", *words)
    assert refused.code == 2, refused.out + refused.err
    assert said in refused.err
    assert remedy in refused.err
    assert not refused.out
