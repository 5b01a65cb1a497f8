"""The command `fieldkit compare A B`."""

import csv
import json
import shlex
from datetime import UTC, datetime
from pathlib import Path

import pytest

from fieldkit.backends.registry import load_backend
from fieldkit.cli import main
from fieldkit.config.site import load_site
from fieldkit.core.model import Distance, Topology
from fieldkit.trial.procedure import load_procedure
from fieldkit.trial.request import TrialRequest, make_plan
from tests.helpers.tables import COMPARABLE, RepeatRow, bursty, replace, write

TCP = replace(COMPARABLE, protocol="tcp")


def compare(command_line: str) -> int:
    return main(["compare", *command_line.split()])


@pytest.fixture(autouse=True)
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(autouse=True)
def field_rows(lab: Path) -> list[RepeatRow]:
    """Write a field trial and an emulated trial with more loss and equal delay; return the rows of the former."""
    rows = bursty(COMPARABLE, 20, seed=1)
    write(lab / "field", rows)
    lossier_rows = [
        replace(
            row,
            backend="emulated",
            trial="another",
            ip_packets_received=packets_received,
            ip_loss=1 - packets_received / 216,
        )
        for row in rows
        for packets_received in ((row.ip_packets_received or 0) - 40,)
    ]
    write(lab / "sim", lossier_rows)
    return rows


def test_run_does_not_differ_from_itself(capsys: pytest.CaptureFixture[str]) -> None:
    assert compare("field field/trial.csv --threshold rtt_median_s=10ms") == 0
    output = capsys.readouterr()
    assert output.err == "note: may matter: attempts that are in both runs: A has 20, B has 20\n"
    assert "IP packet loss" in output.out
    assert "no difference seen; up to " in output.out
    assert ": 0 differences seen, 0 after correction" in output.out


def test_field_and_simulation_differ_in_loss(capsys: pytest.CaptureFixture[str]) -> None:
    assert compare("field sim") == 0
    output = capsys.readouterr().out
    assert output.startswith("los, master, 9.144 m, udp: A 20 valid; B 20 valid\n")
    (loss,) = (line for line in output.splitlines() if "IP packet loss" in line)
    assert "B 18.52 points more [" in loss
    assert ": 1 difference seen, 1 after correction" in output


@pytest.mark.parametrize(
    ("thresholds", "code"),
    [
        ("--threshold rtt_median_s=10ms", 0),
        ("--threshold rtt_median_s=0.1ms", 1),
        ("--threshold ip_loss=2%", 1),
        ("--threshold ip_loss=90% --threshold rtt_median_s=10ms", 0),
        ("--threshold ip_loss=2% --threshold rtt_median_s=10ms", 1),
    ],
)
def test_a_threshold_decides_the_exit_code(thresholds: str, code: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert compare(f"field sim {thresholds}") == code
    assert ("\nnot shown to be within " in capsys.readouterr().out) is bool(code)


def test_condition_of_only_one_run_is_listed(
    lab: Path, field_rows: list[RepeatRow], capsys: pytest.CaptureFixture[str]
) -> None:
    write(lab / "more", [*field_rows, *bursty(TCP, 20, seed=3)])
    assert compare("field more") == 0
    assert "not compared, because A has no such condition: los, master, 9.144 m, tcp" in capsys.readouterr().out
    assert compare("field more --format csv") == 0
    rows = list(csv.DictReader(capsys.readouterr().out.splitlines()))
    assert {(row["protocol"], row["missing_in"]) for row in rows} == {("udp", ""), ("tcp", "A")}
    assert {row["difference"] for row in rows if row["missing_in"]} == {""}


def test_runs_that_are_not_comparable_are_rejected_without_force(
    lab: Path, field_rows: list[RepeatRow], capsys: pytest.CaptureFixture[str]
) -> None:
    write(lab / "other", [replace(row, procedure_sha256="ffff", sent_bytes=293_797) for row in field_rows])
    assert compare("field other") == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err == (
        "error: A and B are not comparable:\n"
        "  procedure_sha256: A has bbbb, B has ffff (los, master, 9.144 m, udp)\n"
        "  sent_bytes, median: A has 230,695 B, B has 293,797 B (los, master, 9.144 m, udp)\n"
        "  remedy: run both under the same conditions (to look up a name: fieldkit columns show NAME); "
        "or, to compare them anyway, add --force\n"
    )
    assert compare("field other --force") == 0
    output = capsys.readouterr()
    assert "not comparable: procedure_sha256: A has bbbb, B has ffff" in output.err
    assert "no difference seen" in output.out


def test_all_formats_agree(capsys: pytest.CaptureFixture[str]) -> None:
    outputs = {}
    for form in ("csv", "json", "markdown", "table"):
        assert compare(f"field sim --threshold ip_loss=2% --format {form}") == 1
        outputs[form] = capsys.readouterr().out
    (csv_row,) = (row for row in csv.DictReader(outputs["csv"].splitlines()) if row["quantity"] == "ip_loss")
    document = json.loads(outputs["json"])
    (json_row,) = (row for row in document["differences"] if row["quantity"] == "ip_loss")
    assert document["missed"] is True
    assert float(csv_row["difference"]) == pytest.approx(json_row["difference"]) == pytest.approx(40 / 216)
    assert csv_row["within"] == "false"
    assert csv_row["verdict"] == json_row["verdict"]
    assert json_row["verdict"] in outputs["markdown"]
    assert json_row["verdict"] in outputs["table"]
    for line in document["conclusions"]:
        assert line in outputs["markdown"]
        assert line in outputs["table"]


SITE = """\
robots:
  turtlebot: {profile: turtlebot3_burger, host: 192.0.2.1, user: pi, address: 10.9.9.1, host_key: ssh-ed25519 AAAA}
  drone: {profile: duckiedrone, host: 192.0.2.2, user: duckie, address: 10.9.9.2, host_key: ssh-ed25519 AAAA}
roles:
  masterless: {sender: turtlebot, receiver: drone}
"""


def test_a_lab_has_the_same_hashes_in_the_field_and_emulated(lab: Path) -> None:
    (lab / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    site, document = load_site(Path("fieldkit.yaml"))
    request = TrialRequest(load_procedure("los"), Distance(9.144, "30ft"), topology=Topology.MASTERLESS)
    plans = []
    for name in ("field", "emulated"):
        cast = load_backend(name, site, document).cast(Topology.MASTERLESS)
        plans.append(make_plan(request, backend=name, cast=cast, now=datetime.now(UTC)))
    field_plan, emulated_plan = plans
    assert field_plan.cast != emulated_plan.cast
    assert field_plan.profiles_sha256 == emulated_plan.profiles_sha256
    assert field_plan.procedure_sha256 == emulated_plan.procedure_sha256


def test_more_than_two_runs_suggest_aggregate(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (lab / "field again").symlink_to("field")
    assert main(["compare", "field", "sim", "field again"]) == 2
    message = capsys.readouterr().err
    assert "compare needs two runs, A and B, and 3 are given" in message
    command = message.partition("in one table: fieldkit ")[2].strip()
    assert command == "aggregate field sim 'field again' --by trial,protocol"
    assert main(shlex.split(command)) == 0
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main(["compare", "--help"])
    assert "A [B]\n" in capsys.readouterr().out, "the help shows two runs"


def test_equal_inputs_give_equal_bytes(capsys: pytest.CaptureFixture[str]) -> None:
    outputs = []
    for _ in range(2):
        compare("field sim --format json")
        outputs.append(capsys.readouterr().out)
    assert outputs[0] == outputs[1]


def write_farther_trials(lab: Path, field_rows: list[RepeatRow], *names: str) -> None:
    """Write the field trial at other distances into one folder per distance."""
    for number, name in enumerate(names, start=2):
        write(lab / name, [replace(row, distance_m=9.144 * number, trial=name) for row in field_rows])


def test_runs_that_differ_only_in_distance_compare_by_protocol(
    lab: Path, field_rows: list[RepeatRow], capsys: pytest.CaptureFixture[str]
) -> None:
    write_farther_trials(lab, field_rows, "far")
    assert compare("field far") == 2
    error_text = capsys.readouterr().err
    assert (
        "only distance_m differs; to compare one with the other: fieldkit compare field far --by protocol"
        in error_text
    )
    assert compare("field far --by protocol") == 0
    output = capsys.readouterr()
    assert output.err.startswith(
        "note: A and B differ in this, which may explain differences between their figures: distance_m: A has 9.1"
    )
    assert output.out.startswith("udp: A 20 valid; B 20 valid\n")
    assert compare("field far --by protocol --format markdown") == 0
    assert (
        "- A and B differ in this, which may explain differences between their figures: distance"
        in capsys.readouterr().out
    )


def test_run_with_several_distances_does_not_compare(
    lab: Path, field_rows: list[RepeatRow], capsys: pytest.CaptureFixture[str]
) -> None:
    write_farther_trials(lab, field_rows, "far/two", "far/three")
    assert compare("field far --by protocol") == 2
    assert "distance_m: A has 9.144, B has 18.288, 27.432" in capsys.readouterr().err
    assert compare("field far") == 2
    assert "or, to compare these: fieldkit compare field far --by protocol --force" in capsys.readouterr().err


def test_different_distance_does_not_allow_other_differences(lab: Path, field_rows: list[RepeatRow]) -> None:
    write(
        lab / "other", [replace(row, distance_m=20.0, procedure_sha256="cccc", trial="other") for row in field_rows]
    )
    assert compare("field other --by protocol") == 2
    assert compare("field other --by protocol --force") == 0
