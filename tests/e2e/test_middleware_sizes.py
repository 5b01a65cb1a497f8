"""A part of the shipped campaign of message sizes on a link with a known loss, and the settings it recommends."""

import re
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from fieldkit.ros.middlewares import tuning
from tests.helpers.paths import ROOT
from tests.helpers.runs import only_trial, run_here

pytestmark = pytest.mark.emulated

EXAMPLE = ROOT / "docs" / "examples" / "middleware"
REPEATS = 2


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with trials of the shipped procedure, with only its smallest samples, tuned settings and blocking."""
    home = tmp_path_factory.mktemp("sizes")
    text = (ROOT / "procedures" / "middleware_sizes.yaml").read_text(encoding="utf-8")
    text = text.replace("name: middleware_sizes", "name: sizes_sample", 1).replace("[last, all]", "[all]")
    text = text.replace("[default, tuned]", "[tuned]")
    head, smallest, *_ = text.split("        - for:\n            each: {bytes: ")
    assert smallest.startswith("[1000, 10000, 100000]")
    smallest = smallest.replace("[1000, 10000, 100000]", "[1000]").replace("duration: 4s", "duration: 1s")
    text = f"{head}        - for:\n            each: {{bytes: {smallest.replace('count: 20', 'count: 5')}"
    (home / "procedures").mkdir()
    (home / "procedures" / "sizes_sample.yaml").write_text(text, encoding="utf-8")
    (home / "fieldkit.yaml").write_text((EXAMPLE / "loss-2.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    run = run_here(home, "trial", "sizes_sample", "5m", "--repeats", str(REPEATS), "--yes")
    assert run.code == 0, run.out + run.err
    return home


def test_recommended_settings_are_written_with_their_evidence(lab: Path) -> None:
    out = lab / "passed"
    words = ("middleware", "recommend", "trials", "-o", str(out), "--repeats", str(REPEATS), "--max-loss", "20%")
    run = run_here(lab, *words)
    assert run.code == 0, run.out + run.err
    assert sorted(path.name for path in out.iterdir()) == ["cyclonedds.xml", "zenoh.json5"]
    assert len(re.findall(r"(?m)^passed: (dds|zenoh)", run.out)) == 2, run.out
    for path in out.iterdir():
        text = path.read_text(encoding="utf-8")
        assert f"{REPEATS} of {REPEATS} repeats are valid" in text
        assert only_trial(lab).name in text
        assert "loss at most 20 %, in each repeat" in text
    domain = ET.parse(out / "cyclonedds.xml").getroot().find("Domain")
    assert domain is not None
    values = {f"{outer.tag}/{inner.tag}": inner.text for outer in domain for inner in outer}
    assert values == dict(tuning.recommended_settings("dds", "tcp"))


@pytest.mark.parametrize(
    ("criterion", "reason"),
    [
        (("--repeats", "9"), "undecided"),
        (("--repeats", str(REPEATS), "--max-loss", "20%", "--max-delay", "1us"), "failed|undecided"),
        (("--size", "10kB"), "no trial has"),
        (("--repeats", str(REPEATS), "--max-loss", "20%", "--share", "90%"), "undecided.*\n.*29 repeats are needed"),
    ],
)
def test_without_evidence_no_settings_are_written(lab: Path, criterion: tuple[str, ...], reason: str) -> None:
    out = lab / "nothing"
    run = run_here(lab, "middleware", "recommend", "trials", "-o", str(out), *criterion)
    assert run.code == 1, run.out + run.err
    assert re.search(reason, run.out), run.out
    assert "passed:" not in run.out
    assert not out.exists()


@pytest.mark.parametrize("loss", [0, 2, 10])
def test_the_shipped_campaigns_can_run(tmp_path: Path, loss: int) -> None:
    for name in (f"sizes-{loss}.yaml", f"loss-{loss}.yaml"):
        (tmp_path / name).write_text((EXAMPLE / name).read_text(encoding="utf-8"), encoding="utf-8")
    run = run_here(tmp_path, "campaign", f"sizes-{loss}.yaml", "--site", f"loss-{loss}.yaml", "--dry-run")
    assert run.code == 0, run.err
    assert "0 of 1 trials are done" in run.out


def test_the_shipped_collapse_procedure_can_run(tmp_path: Path) -> None:
    (tmp_path / "procedures").mkdir()
    text = (EXAMPLE / "procedures" / "collapse.yaml").read_text(encoding="utf-8")
    (tmp_path / "procedures" / "collapse.yaml").write_text(text, encoding="utf-8")
    run = run_here(tmp_path, "trial", "collapse", "20m", "--dry-run")
    assert run.code == 0, run.err
    assert "-B 32768" in run.out
    assert "-s 256" in run.out


@pytest.mark.parametrize(
    ("option", "value"), [("--max-loss", "101%"), ("--share", "100%"), ("--share", "0%"), ("--repeats", "1")]
)
def test_impossible_criteria_are_rejected(tmp_path: Path, option: str, value: str) -> None:
    run = run_here(tmp_path, "middleware", "recommend", ".", "-o", "config", option, value)
    assert run.code == 2, run.out
    assert option in run.err
    assert not (tmp_path / "config").exists()
