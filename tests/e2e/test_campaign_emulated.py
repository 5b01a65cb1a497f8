"""Campaigns end to end: one is killed and run again; another skips trials and records notes on the field backend."""

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from fieldkit.core.model import Topology
from tests.helpers.field_robots import start_field_robots
from tests.helpers.host import descendants, wait_for_end
from tests.helpers.labs import built_in_ros
from tests.helpers.runs import Run, finish, rows, run_here, start, wait_for_line

pytestmark = pytest.mark.emulated

CAMPAIGN = """\
name: lawn
procedures: [los]
distances: [{distances}]
topologies: [master, masterless]
protocols: [tcp]
repeats: 1
record: 1s
seed: 7
"""


def write_lab(lab: Path, distances: str) -> Path:
    built_in_ros(lab)
    (lab / "lawn.yaml").write_text(CAMPAIGN.format(distances=distances), encoding="utf-8")
    return lab / "trials" / "campaign_lawn"


def journal(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "journal.jsonl").read_text(encoding="utf-8").splitlines()]


def count_events(folder: Path) -> Counter[tuple[str, str]]:
    return Counter((entry["turn"], entry["what"]) for entry in journal(folder))


def trials(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir())


def test_a_campaign_killed_in_a_trial_continues_and_has_each_trial_once(tmp_path: Path) -> None:
    folder = write_lab(tmp_path, "10ft, 20ft")
    process = start(tmp_path, "campaign", "lawn.yaml", "--json")
    wait_for_line(process, '"campaign_went"')
    wait_for_line(process, '"transfer"')
    process_ids = descendants(process.pid)
    process.kill()
    process.wait(60)
    assert process.stdout is not None
    process.stdout.close()
    wait_for_end(process_ids, within_s=60.0)
    with (folder / "journal.jsonl").open("a", encoding="utf-8") as file:
        file.write('{"utc_ns": 17952')
    before = trials(folder)
    assert len(before) == 2

    run = run_here(tmp_path, "campaign", "lawn.yaml", "--json")
    assert run.code == 0, run.err
    (planned,) = run.events("campaign_planned")
    assert (len(planned["trials"]), planned["total"]) == (3, 4)
    assert trials(folder)[:2] == before, "the killed trial continues in its folder"
    assert len(trials(folder)) == 4
    assert "recover" in {event["name"] for event in run.events("phase_started")}
    order = [f"los {distance} {topology}" for topology in Topology for distance in ("10ft", "20ft")]
    assert count_events(folder) == Counter(
        {(turn, event): 1 for turn in order for event in ("started", "ended")}
    ) + Counter({(turn, "placed"): 2 if turn == planned["trials"][0] else 1 for turn in order})
    for trial in trials(folder):
        assert [row["status"] for row in rows(trial) if row["status"] != "void"] == ["valid"]
    assert run_here(tmp_path, "verify", str(before[1])).code == 0
    remaining_s = [event["left_s"] for event in run.events("campaign_went")]
    assert remaining_s == sorted(remaining_s, reverse=True)
    assert remaining_s[-1] == 0

    second_run = run_here(tmp_path, "campaign", "lawn.yaml")
    assert second_run.code == 0, second_run.err
    assert "4 of 4 trials are done" in second_run.out
    assert len(trials(folder)) == 4


def run_with_answers(lab: Path, *answers: str) -> Run:
    (lab / "answers.txt").write_text("".join(f"{answer}\n" for answer in answers), encoding="utf-8")
    return run_here(lab, "campaign", "lawn.yaml", "--answers", "answers.txt", "--json")


def test_skipped_trials_are_offered_again_and_notes_are_stored(tmp_path: Path) -> None:
    folder = write_lab(tmp_path, "10ft")
    with start_field_robots(tmp_path, topology=Topology.MASTER):
        site = tmp_path / "fieldkit.yaml"
        roles = "roles: {masterless: {sender: turtlebot-1, receiver: duckiedrone-1}, "
        site.write_text(site.read_text(encoding="utf-8").replace("roles: {", roles), encoding="utf-8")

        skipped_run = run_with_answers(tmp_path, "s", "", "s", "", "s", "", "s")
        assert skipped_run.code == 1, skipped_run.err
        assert "run the same command again" in skipped_run.err
        assert trials(folder) == [], "skipped trials leave no folder"

        first, second = skipped_run.events("campaign_planned")[0]["trials"]
        run = run_with_answers(tmp_path, "s", "n rigged by Ann", "n wet grass", "", "")
        assert run.code == 0, run.err
        questions = [event["text"] for event in run.events("request")]
        move = {
            "los 10ft master": "move turtlebot-1 and turtlebot-2 to 10 ft (3.05 m) from duckiedrone-1, "
            "on opposite sides of it, nothing between them",
            "los 10ft masterless": "move turtlebot-1 to 10 ft (3.05 m) from duckiedrone-1, nothing between them",
        }
        rig = {
            "los 10ft master": "set the robots up for topology master: "
            "turtlebot-1 as sender, turtlebot-2 as receiver, duckiedrone-1 as relay",
            "los 10ft masterless": "set the robots up for topology masterless: "
            "turtlebot-1 as sender, duckiedrone-1 as receiver",
        }
        assert questions == [move[first], rig[second], move[second], rig[first], move[first]]
        assert [event["may_skip"] for event in run.events("request")] == [True, False, True, False, True]
    first_plan, second_plan = ((trial / "trial.yaml").read_text(encoding="utf-8") for trial in trials(folder))
    assert "notes: campaign lawn; rigged by Ann; wet grass\n" in first_plan
    assert "notes: campaign lawn\n" in second_plan
    assert [entry["note"] for entry in journal(folder) if entry["what"] == "placed"] == ["wet grass", ""]
    assert count_events(folder)[first, "skipped"] == 3
    assert count_events(folder)[first, "ended"] == count_events(folder)[second, "ended"] == 1


def test_a_program_can_answer_through_a_pipe(tmp_path: Path) -> None:
    folder = write_lab(tmp_path, "10ft")
    with start_field_robots(tmp_path, topology=Topology.MASTERLESS):
        text = (tmp_path / "lawn.yaml").read_text(encoding="utf-8").replace("[master, masterless]", "[masterless]")
        (tmp_path / "lawn.yaml").write_text(text, encoding="utf-8")
        process = subprocess.Popen(
            (sys.executable, "-m", "fieldkit", "campaign", "lawn.yaml", "--answers", "-", "--json"),
            cwd=tmp_path,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stdin is not None
        assert process.stdout is not None
        for line in process.stdout:
            if json.loads(line)["event"] == "request":
                process.stdin.write("n by a program\n")
                process.stdin.flush()
                break
        run = finish(process)
    assert run.code == 0, run.err
    (trial,) = trials(folder)
    assert "by a program" in (trial / "trial.yaml").read_text(encoding="utf-8")
