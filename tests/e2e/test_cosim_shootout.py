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
        assert {row for name, row in found[policy].items() if "error" in name} == {"0"}
    # Half a window of 10 ms, waited for by what arrives anywhere in it.
    assert 0 < float(found["scheduled"]["delivery_error_mean_s"]) <= 0.010
    assert float(found["scheduled"]["exchanges_per_s"]) == pytest.approx(100)
    assert int(float(found["sliding_window"]["causality_violations"])) > 0
    assert float(found["sliding_window"]["position_error_max_m"]) <= 1.0 * 0.010 + 1e-9, "1 m/s for a window"


def test_the_same_numbers_come_twice_but_for_wall_time(lab: Path) -> None:
    def numbers() -> list[dict[str, str]]:
        found = json.loads(cosim(lab, "shootout", "pass.yaml", "--format", "json").out)
        timed = re.compile("wall|real_time")
        return [{name: value for name, value in row.items() if not timed.match(name)} for row in found]

    assert numbers() == numbers()


def test_the_table_says_what_its_columns_mean_in_100_columns(lab: Path) -> None:
    done = cosim(lab, "shootout", "pass.yaml", "--window", "2ms,20ms")
    assert done.code == 0, done.err
    assert max(map(len, done.out.splitlines())) <= 100
    for head in ("time (ms)", "p95", "max", "fate (%)", "late", "added", "place (mm)", "per s", "speed"):
        assert head in done.out
        assert f"{head.partition(' (')[0]}: " in " ".join(done.out.split()), "what it means"


def test_the_figure_names_every_policy_and_is_the_same_twice(lab: Path) -> None:
    for name in ("one.svg", "two.svg", "one.pdf"):
        done = cosim(lab, "shootout", "pass.yaml", "--window", "2ms,20ms", "--figure", name)
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
    options = ("--orders", "--duration", "1s", "--policy", "scheduled", "--window", "10ms,40ms", "--figure", "o.svg")
    done = cosim(lab, "shootout", "pass.yaml", *options)
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
        (("--figure", "x.jpg"), "--figure: what 'x.jpg' should be is not clear", ".svg, .pdf, .png"),
        (("--figure", "none/x.svg"), "none: there is no such folder", "mkdir -p none"),
    ],
)
def test_bad_input_is_told_with_a_remedy(lab: Path, words: tuple[str, ...], said: str, remedy: str) -> None:
    refused = cosim(lab, "shootout", "pass.yaml", *words)
    assert refused.code == 2, refused.out + refused.err
    assert said in refused.err
    assert remedy in refused.err
    assert not refused.out
