"""Every bad input of docs/errors.md produces the listed message and remedy, and the listed exit code."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from fieldkit.campaign import plan
from fieldkit.campaign.journal import CampaignJournal
from fieldkit.cli import main
from fieldkit.config.locations import Kind
from fieldkit.core.model import Protocol, RepeatId, Status
from fieldkit.trial import journal, store
from fieldkit.trial.journal import JournalEntry
from fieldkit.trial.running.ledger import Ledger
from fieldkit.trial.running.stop import Stop
from fieldkit.trial.stored import plans
from tests.helpers import labs, lawns, recorded, tables
from tests.helpers.paths import ROOT
from tests.helpers.tables import RepeatRow, replace

PAGE = (ROOT / "docs" / "errors.md").read_text(encoding="utf-8")

LAB = """\
backend: emulated
robots:
  turtlebot-1: {profile: turtlebot3_burger}
  turtlebot-2: {profile: turtlebot3_burger}
  duckiedrone-1: {profile: duckiedrone}
roles:
  master: {sender: turtlebot-1, receiver: turtlebot-2, relay: duckiedrone-1}
"""
FIELD = """\
backend: field
robots:
  turtlebot-1: {profile: turtlebot3_burger, host: 192.0.2.1, user: pi, host_key: ssh-ed25519 AAAA}
roles: {}
"""
CAMPAIGN = """\
name: lawn
procedures: [los]
distances: [10ft, 20ft]
topologies: [master]
seed: 7
"""
DRY = "trial los 30ft --dry-run"

Setup = Callable[[Path], str]
"""Prepares a lab's folder and returns the command."""


@dataclass(frozen=True)
class Row:
    """A row of a table in docs/errors.md; `...` stands for text that differs between labs."""

    situation: str
    code: int
    message: str
    remedy: str


def table(section: str) -> dict[str, Row]:
    body = re.search(rf"^## {re.escape(section)}$(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL)
    assert body, section
    rows_by_situation = {}
    for line in body[1].splitlines():
        if re.match(r"\| (?!what is wrong|---)", line):
            situation, code, message, remedy = (_without_backticks(cell) for cell in line.strip("| ").split(" | "))
            rows_by_situation[situation] = Row(situation, int(code), message, remedy)
    return rows_by_situation


def _without_backticks(cell: str) -> str:
    """Return a cell without the backticks that mark code."""
    text = cell.strip()
    backticks = len(text) - len(text.lstrip("`"))
    return text[backticks:-backticks].strip() if backticks else text


def site(text: str = LAB, *changes: str, command: str = DRY) -> Setup:
    def setup(lab: Path) -> str:
        (lab / "fieldkit.yaml").write_text(labs.replace_text(text, *changes), encoding="utf-8")
        return command

    return setup


def changed_copy(kind: Kind, name: str, *changes: str, command: str = DRY) -> Setup:
    def setup(lab: Path) -> str:
        labs.copy_shipped(lab, kind, name, *changes)
        return command

    return setup


def campaign(*changes: str, started: bool = False) -> Setup:
    def setup(lab: Path) -> str:
        text = CAMPAIGN
        path = lab / "lawn.yaml"
        path.write_text(text, encoding="utf-8")
        if started:
            campaign_plan, _ = plan.make_plan(path, "emulated")
            with CampaignJournal(lab / "trials" / "campaign_lawn").locked(campaign_plan):
                pass
        for old, new in zip(changes[::2], changes[1::2], strict=True):
            assert old in text
            text = text.replace(old, new)
        path.write_text(text, encoding="utf-8")
        return "campaign lawn.yaml --dry-run"

    return setup


def without_files(command: str) -> Setup:
    return lambda lab: command


def with_two_runs(command: str, **changes: Any) -> Setup:  # noqa: ANN401 (as replace)
    """Write two runs in the folders `a` and `b`, the second with `changes`."""

    def setup(lab: Path) -> str:
        rows = tables.bursty(tables.COMPARABLE, 3, seed=1)
        tables.write(lab / "a", rows)
        tables.write(lab / "b", [replace(row, **changes) for row in rows])
        return command

    return setup


COMMAND_LINE_CASES: dict[str, Setup] = {
    "a distance without a unit": without_files("trial los 30"),
    "an unknown unit": without_files("trial los 30feet"),
    "a distance of zero": without_files("trial los 0m"),
    "a duration without a unit": without_files("trial los 30ft --record 2"),
    "a recording of zero seconds": without_files("trial los 30ft --record 0s"),
    "an unknown procedure": without_files("trial lso 30ft"),
    "an unknown backend": without_files("trial los 30ft --backend emulatd"),
    "the field backend without a site file": without_files("trial los 30ft --backend field"),
    "a missing site file": without_files("trial los 30ft --site nope.yaml"),
    "a folder for trials that cannot be created": without_files("trial los 30ft --out /proc/trials"),
    "an unknown robot profile": without_files("robots show turtlebot"),
    "an unknown column": without_files("columns show iploss"),
    "a missing file of answers": without_files("trial los 30ft --answers nope.txt"),
    "a report in a folder that is not writable": lambda lab: (
        f"report {tables.write(lab, [lawns.row()])} -o /proc/report.html"
    ),
    "a report in a missing folder": without_files("report . -o there/report.html"),
    "a report in place of another file": lambda lab: (
        f"report . -o {tables.write(lab, [lawns.row()], 'all.csv').relative_to(lab)}"
    ),
    "figures in a folder that is not writable": lambda lab: (
        f"report {tables.write(lab, [lawns.row()])} --figures /proc/figures"
    ),
    "an unknown repeat": lambda lab: f"report {tables.write(lab, [lawns.row()])} --repeat udp-07",
    "a folder that is not a trial": without_files("resume nowhere"),
    "a folder without a manifest": without_files("verify ."),
    "an unknown format": without_files("export . --format parket -o out.parquet"),
    "an export to an existing file": lambda lab: (
        (lab / "out.csv").write_bytes(b""),
        "export . --format csv -o out.csv",
    )[1],
    "an export to a missing folder": without_files("export . --format csv -o there/out.csv"),
    "several trials in one MCAP file": without_files("export one other --format mcap -o out.mcap"),
    "two runs that are not comparable": with_two_runs("compare a b", procedure_sha256="ffff"),
    "two runs without a common condition": with_two_runs("compare a b", distance_m=16.764),
    "a threshold for an unknown quantity": with_two_runs("compare a b --threshold iploss=2%"),
    "a threshold for a quantity that no run has": with_two_runs("compare a b --threshold rtt_loss=2%"),
    "a threshold without a value": with_two_runs("compare a b --threshold ip_loss"),
    "a threshold without a unit": with_two_runs("compare a b --threshold ip_loss=2"),
    "a threshold of zero": with_two_runs("compare a b --threshold ip_loss=0%"),
    "a lab that is not running": without_files("lab ps"),
    "a lab without robots": without_files("lab up --robots 0"),
    "a lab of a backend that cannot start robots": site(FIELD, command="lab up --backend field"),
    "a figure with an unknown suffix": without_files("lab plot -o lab.gif"),
}

YAML_CASES: dict[str, Setup] = {
    "a key with a typo": site(LAB, "robots:", "robotz:"),
    "a missing key": site(LAB, "{profile: duckiedrone}", "{}"),
    "a key written twice": site(LAB, "roles:", "backend: emulated\nroles:"),
    "an unknown profile in a site file": site(LAB, "duckiedrone}", "duckydrone}"),
    "an unknown world": site(LAB + "emulated: {world: lwn}\n"),
    "a role of an unknown robot": site(LAB, "sender: turtlebot-1", "sender: turtlebot-9"),
    "one robot in two roles": site(LAB, "receiver: turtlebot-2", "receiver: turtlebot-1"),
    "one machine under two names": site(
        LAB,
        "{profile: duckiedrone}",
        "{profile: duckiedrone, host: ground}",
        "turtlebot-2: {profile: turtlebot3_burger}",
        "turtlebot-2: {profile: turtlebot3_burger, host: ground}",
    ),
    "a topology without roles": site(command=f"{DRY} --topology masterless"),
    "master without a relay": site(LAB, ", relay: duckiedrone-1", ""),
    "a broken line": site(LAB, "robots:", "robots: ["),
    "an alias": site(LAB, "backend: emulated", "backend: *field"),
    "a share without a per cent sign": site(LAB + "emulated: {radio: {loss: 0.1}}\n"),
    "an unknown option of the emulated backend": site(LAB + "emulated: {radio: {los: 10%}}\n"),
    "a tag": site(LAB, "backend: emulated", "backend: !radio x"),
    "a tab": site(LAB, "  turtlebot-2:", "\tturtlebot-2:"),
    "a whole number in quotes": site(
        LAB, "turtlebot-1: {profile: turtlebot3_burger}", "turtlebot-1: {profile: turtlebot3_burger, port: '22'}"
    ),
    "an IPv6 address on the radio": site(FIELD, "host: 192.0.2.1", "host: 192.0.2.1, address: '2001:db8::1'"),
    "a name for an address on the radio": site(
        FIELD,
        "host: 192.0.2.1",
        "host: ground.example",
        "roles: {}",
        "roles: {masterless: {sender: turtlebot-1}}",
        command=f"{DRY} --topology masterless",
    ),
    "a robot without a host in the field": site(LAB, "backend: emulated", "backend: field"),
    "a password in the site file": site(LAB, "{profile: duckiedrone}", "{profile: duckiedrone, password: s3same}"),
    "a file that is not UTF-8": lambda lab: ((lab / "fieldkit.yaml").write_bytes(b"backend: \xff"), DRY)[1],
    "an unknown kind of step": changed_copy("procedures", "los", "  - ping:", "  - pong:"),
    "a step for a role that does not exist": changed_copy("procedures", "los", "{robot: sender", "{robot: senderr"),
    "a payload that no packet can carry": changed_copy("procedures", "los", "udp: 8192", "udp: 65508"),
    "a second step of the same kind and name": changed_copy(
        "procedures", "los", "during:", "during:\n        - ping: {from: sender, to: receiver}"
    ),
    "one robot that captures twice": changed_copy(
        "procedures", "los", "robots: [sender, receiver]", "robots: [sender, sender]"
    ),
    "an unknown variable": changed_copy(
        "procedures",
        "los",
        "        - ping: {",
        "        - for: {each: {n: [1, 2]}, during: [ping: {name: 'p{m}'}]}\n        - ping: {",
    ),
    "two transfers to one port in one capture": changed_copy(
        "procedures",
        "los",
        "        # The",
        "        - transfer: {name: more, from: sender, to: receiver}\n        # The",
    ),
    "a received file with the name of the bag": changed_copy("procedures", "los", "into: recv.bag", "into: scan.bag"),
    "a rate without a unit": changed_copy("robots", "turtlebot3_burger", "rate: 5Hz", "rate: 5"),
    "a profile whose name differs from its file": changed_copy(
        "robots", "duckiedrone", "name: duckiedrone", "name: drone"
    ),
    "a record command without its topics": changed_copy("robots", "turtlebot3_burger", '"{topics}"]', "]"),
    "a campaign without a seed": campaign("seed: 7\n", ""),
    "one distance twice": campaign("20ft", "3.048m"),
    "an entry of `except` that matches no trial": campaign("seed: 7", "seed: 7\nexcept: [{distance: 55ft}]"),
    "a `walk` below the shortest path": campaign("seed: 7", "seed: 7\nwalk: 12m"),
    "a campaign file that changed": campaign("seed: 7", "seed: 8", started=True),
}


def with_trial_table(
    *rows: RepeatRow, options: str = "", other: RepeatRow | None = None, cut: int | None = None
) -> Setup:
    """Write the table of a trial, optionally without its last `cut` characters; `other` is a different copy of it."""

    def setup(lab: Path) -> str:
        path = tables.write(lab / "trials" / "a", rows)
        if cut is not None:
            path.write_text(path.read_text(encoding="utf-8")[:-cut], encoding="utf-8")
        if other is not None:
            tables.write(lab / "trials" / "b", [other])
        return f"aggregate trials {options}"

    return setup


def with_empty_trial(command: str, *, with_table: bool = True) -> Setup:
    """Write a trial that has a plan and no repeat."""

    def setup(lab: Path) -> str:
        path = tables.write(lab / "trials" / "a", [])
        (path.parent / "trial.yaml").write_bytes(b"")
        if not with_table:
            path.unlink()
        return command

    return setup


def with_changed_trial(command: str, change: Callable[[Path], object]) -> Setup:
    """Write a complete trial and apply a change to it."""

    def setup(lab: Path) -> str:
        folder = recorded.make(lab / "recorded").rename(lab / "a")
        Ledger(plans.read_plan(folder), folder, Stop()).summarize()
        change(folder)
        return command

    return setup


def replace_table_by_link(trial: Path) -> None:
    (trial / "trial.csv").unlink()
    (trial / "trial.csv").symlink_to("/etc/passwd")


def add_evidence(trial: Path) -> None:
    (trial / "repeats" / "udp-01" / "medium.txt").touch()


def add_journal_entry(trial: Path) -> None:
    repeat = RepeatId(Protocol.UDP, 7)
    journal.append(trial, JournalEntry(1, repeat.protocol, repeat.number, 1, Status.RUNNING))


STORED_TRIAL_CASES: dict[str, Setup] = {
    "a missing path": without_files("aggregate nowhere"),
    "a folder without a trial": without_files("aggregate ."),
    "a table without repeats": lambda lab: (
        (lab / "a.csv").write_text("time,x\n1,2\n"),
        "aggregate a.csv",
    )[1],
    "a truncated line": with_trial_table(*tables.repeats(tables.ROW, 3), cut=20),
    "a cell that is not a number": with_trial_table(replace(tables.ROW, distance_m="near")),
    "a table of a newer fieldkit": with_trial_table(replace(tables.ROW, schema_version=99)),
    "two copies of a trial that differ": with_trial_table(tables.ROW, other=replace(tables.ROW, transfer_s=2.0)),
    "trials in which no repeat has ended": with_empty_trial("aggregate trials"),
    "trials whose tables were deleted": with_empty_trial("aggregate trials", with_table=False),
    "a table without rows": lambda lab: (with_trial_table()(lab), "aggregate trials/a/trial.csv")[1],
    "a table without raw evidence to rebuild from": with_trial_table(tables.ROW, options="--rebuild"),
    "an unknown column in --by": with_trial_table(tables.ROW, options="--by distanse"),
    "an unknown quantity": with_trial_table(tables.ROW, options="--quantity ip_los"),
    "a width without a unit": with_trial_table(tables.ROW, options="--width 2"),
    "a width with the unit of another quantity": with_trial_table(
        tables.ROW, options="--width 1ms --quantity ip_loss"
    ),
    "a LaTeX table of a quantity without values": with_trial_table(
        tables.ROW, options="--format latex --quantity jitter_s"
    ),
    "a link in the folder of a trial": with_changed_trial("rebuild a", replace_table_by_link),
    "evidence that was changed after the measurement": with_changed_trial("rebuild a", add_evidence),
    "a journal with an impossible entry": with_changed_trial("rebuild a", add_journal_entry),
    "a file that is not a manifest": with_changed_trial(
        "verify a", lambda trial: (trial / store.MANIFEST_FILE).write_text("x\n", encoding="utf-8")
    ),
}

SECTIONS: dict[str, dict[str, Setup]] = {
    "Command line": COMMAND_LINE_CASES,
    "YAML files": YAML_CASES,
    "Stored trials": STORED_TRIAL_CASES,
}


@pytest.mark.parametrize(("section", "cases"), SECTIONS.items())
def test_the_page_lists_the_tested_inputs(section: str, cases: dict[str, Setup]) -> None:
    assert list(table(section)) == list(cases)


@pytest.mark.parametrize(
    ("row", "setup"),
    [(row, cases[name]) for section, cases in SECTIONS.items() for name, row in table(section).items()],
    ids=lambda value: value.situation if isinstance(value, Row) else "",
)
def test_a_bad_input_gives_one_message_with_a_remedy(
    row: Row, setup: Setup, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code = main(setup(tmp_path).split())
    check(row, code, capsys.readouterr().err)


def check(row: Row, code: int, err: str) -> None:
    assert err.count("error: ") == 1, err
    message = search_text(row.message, err)
    assert message, (row.message, err)
    assert search_text(row.remedy, err[message.end() :]), (row.remedy, err)
    assert code == row.code, err


def search_text(pattern: str, text: str) -> re.Match[str] | None:
    parts = (re.escape(part) for part in pattern.split("..."))
    return re.search(".*?".join(parts), text, re.DOTALL)
