"""Comparison of two recorded outputs: only natural-language text may differ."""

import json
from collections import Counter
from pathlib import Path

import pytest

from benchmarks.unchanged import comparison
from benchmarks.unchanged.comparison import Differences
from benchmarks.unchanged.items import Item, ItemKind, Simulation
from benchmarks.unchanged.trees import Tree

Files = dict[str, str | bytes]
ABORT = Item(ItemKind.COMMAND_LINES, ("abort",), succeeds=False)


def write_trees(tmp_path: Path, *outputs_of_trees: Files) -> list[Tree]:
    recorded_trees = []
    for name, files in zip(("base", "head"), outputs_of_trees, strict=True):
        tree = Tree(tmp_path / name, "0" * 40)
        folder = tree.results / "0"
        defaults: Files = {"exit_code": "0\n", "stdout": "", "stderr": ""}
        for file, content in (defaults | files).items():
            path = folder / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(
                content if isinstance(content, bytes) else content.replace("LAB", str(tree.lab)).encode()
            )
        recorded_trees.append(tree)
    return recorded_trees


def compare_outputs(tmp_path: Path, item: Item, before: Files, after: Files) -> Differences:
    return comparison.compare(item, 0, *write_trees(tmp_path, before, after))


def command(name: str, text: str) -> str:
    return json.dumps({"event": "command_planned", "utc_ns": 5, "name": name, "command": text}) + "\n"


@pytest.mark.parametrize(
    ("item", "before", "after"),
    [
        (ABORT, {"stderr": "error: LAB/a.yaml: no such key\n"}, {"stderr": "error: LAB/a.yaml: no such key\n"}),
        (
            Item(ItemKind.DRY_RUNS, ("trial",)),
            {"stdout": command("a", "sh .fieldkit/job-0123456789ab.sh 20261122T010946.593049Z_los")},
            {"stdout": command("a", "sh .fieldkit/job-ffff56789abc.sh 20261123T010946.593050Z_los")},
        ),
    ],
)
def test_folders_stamps_and_hashes_of_programs_may_differ(
    tmp_path: Path, item: Item, before: Files, after: Files
) -> None:
    assert compare_outputs(tmp_path, item, before, after) == Differences()


@pytest.mark.parametrize(
    ("item", "file", "before", "after", "label"),
    [
        (
            ABORT,
            "stderr",
            "error: mend it, 3 tell\n",
            "error: fix it, 3 report\n",
            ("mend it, 3 tell", "fix it, 3 report"),
        ),
        (
            Item(ItemKind.HELP, ("--help",)),
            "stdout",
            "  --json  who asks\n",
            "  --json  program\n",
            ("who asks", "program"),
        ),
        (Item(ItemKind.REPORTS), "r.html", "<td>echo loss</td>\n", "<td>ping loss</td>\n", ("<td>echo", "<td>ping")),
        (ABORT, "stdout", '{"text": "2 told"}', '{"text": "2 shown"}', ("told", "shown")),
    ],
)
def test_changed_words_are_labels(  # noqa: PLR0917
    tmp_path: Path, item: Item, file: str, before: str, after: str, label: tuple[str, str]
) -> None:
    assert compare_outputs(tmp_path, item, {file: before}, {file: after}) == Differences(labels=Counter([label]))


SIMULATION = Item(ItemKind.SIMULATIONS, simulation=Simulation("baylands", "scheduled", 1, 9))


@pytest.mark.parametrize(
    ("item", "before", "after"),
    [
        (ABORT, {"exit_code": "2\n"}, {"exit_code": "3\n"}),
        (ABORT, {"stderr": "error: 3 robots"}, {"stderr": "error: 4 robots"}),
        (Item(ItemKind.HELP), {"stdout": "--json x"}, {"stdout": "--lines x"}),
        (Item(ItemKind.TABLES, ("rebuild",)), {"trial.csv": "told,b\n"}, {"trial.csv": "shown,b\n"}),
        (Item(ItemKind.TABLES, ("aggregate", "csv")), {"stdout": "told,b\n"}, {"stdout": "shown,b\n"}),
        (Item(ItemKind.EXPORTS), {"out.mcap": b"\xff\x00"}, {"out.mcap": b"\xff\x01"}),
        (Item(ItemKind.EXPORTS), {"out": ""}, {}),
        (Item(ItemKind.DRY_RUNS), {"stdout": command("a", "ping -c 5")}, {"stdout": command("a", "ping -q 5")}),
        (Item(ItemKind.DRY_RUNS), {"stdout": command("told", "ping")}, {"stdout": command("shown", "ping")}),
        (Item(ItemKind.DRY_RUNS), {"stdout": '{"event": "note"}'}, {"stdout": '{"kind": "note"}'}),
        (Item(ItemKind.DRY_RUNS), {"stdout": command("a", "x") * 2}, {"stdout": command("a", "x")}),
        (SIMULATION, {"stdout": "ab"}, {"stdout": "ac"}),
    ],
)
def test_everything_else_is_a_difference(tmp_path: Path, item: Item, before: Files, after: Files) -> None:
    differences = compare_outputs(tmp_path, item, before, after)
    assert differences.real
    assert not differences.labels


def test_failure_at_the_base_commit_proves_nothing(tmp_path: Path) -> None:
    failed_output: Files = {"exit_code": "3\n", "stderr": "error: no namespaces"}
    (difference,) = compare_outputs(tmp_path, Item(ItemKind.TRIALS), failed_output, failed_output).real
    assert difference.startswith("it failed before the change (exit code 3)")


def test_emulated_trials_may_differ_in_numbers_but_not_in_fields_files_and_columns(tmp_path: Path) -> None:
    def trial(
        field: str = "left_s", left_s: float | None = 1.5, header: str = "a,b", repeat: str = "udp-01"
    ) -> Files:
        event = {"event": "repeat_ended", "utc_ns": 1, "repeat": repeat, field: left_s}
        return {"stdout": json.dumps(event), f"trials/20261122T010946.1Z/{repeat}/trial.csv": f"{header}\n{left_s}\n"}

    item = Item(ItemKind.TRIALS)
    assert compare_outputs(tmp_path / "same", item, trial(), trial(left_s=None, repeat="udp-02")) == Differences()
    for number, different_trial in enumerate((trial(field="left"), trial(header="a,c"), trial(repeat="tcp-01"))):
        assert compare_outputs(tmp_path / str(number), item, trial(), different_trial).real
