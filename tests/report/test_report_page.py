"""The page and its figures: the bytes are reproducible, and texts of the evidence are escaped."""

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from fieldkit.cli import main
from tests.helpers import lawns, tables
from tests.helpers.runs import run_here

HOSTILE = "<script>alert(1)</script>\"' onload=x $\\frac$ \u202e\x1b[31m]]>--><svg/onload=alert(1)>"


class Elements(HTMLParser):
    """The elements of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.ids: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        self.ids += [value or "" for name, value in attrs if name == "id"]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The text of a report of synthetic trials."""
    folder = tmp_path_factory.mktemp("lawn")
    report_path = folder / "report.html"
    assert main(["report", str(tables.write(folder, lawns.lawn(2))), "-o", str(report_path)]) == 0
    return report_path.read_text(encoding="utf-8")


def test_two_runs_give_the_same_bytes(tmp_path: Path) -> None:
    rows = [
        tables.replace(row, transfer_s=None)  # this leaves three figures of six
        for row in lawns.lawn(2)
        if (row.topology, row.backend, row.protocol) == ("master", "field", "udp") and row.distance != "55ft"
    ]
    path = tables.write(tmp_path, rows)
    runs = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        run = run_here(tmp_path / name, "report", str(path), "--figures", "figures")
        assert run.code == 0, run.err
        files = sorted(file for file in (tmp_path / name).rglob("*") if file.is_file())
        runs.append({str(file.relative_to(tmp_path / name)): file.read_bytes() for file in files})
    assert runs[0] == runs[1]
    assert {Path(name).suffix for name in runs[0]} == {".html", ".svg", ".pdf", ".png"}
    assert runs[0]["figures/rtt-median.png"].startswith(b"\x89PNG")
    assert runs[0]["figures/rtt-median.pdf"].startswith(b"%PDF")


def test_texts_of_the_evidence_are_escaped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    hostile = {"procedure": HOSTILE, "scenario": "", "topology": HOSTILE, "backend": HOSTILE, "distance": HOSTILE}
    rows = [lawns.row(number, **hostile, trial=HOSTILE, sender=HOSTILE) for number in (1, 2)]
    rows.append(lawns.row(3, **hostile, trial=HOSTILE, status="void", reason=HOSTILE))
    folder = tmp_path / "<b>&\"'"
    assert main(["report", str(tables.write(folder, rows)), "--title", HOSTILE]) == 0
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    elements = Elements(text)
    assert "script" not in elements.tags
    assert "b" not in elements.tags
    assert not [name for name, _ in elements.attributes if name.startswith("on")]
    assert not {"\x1b", "\u202e"} & set(text)
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text


def test_ids_are_unique_and_all_references_resolve(page: str) -> None:
    elements = Elements(page)
    assert len(elements.ids) == len(set(elements.ids))
    referenced_ids = {
        value[1:] for name, value in elements.attributes if name.endswith("href") and value.startswith("#")
    }
    assert referenced_ids | set(re.findall(r"url\(#([^)]*)\)", page)) <= set(elements.ids)


def test_page_has_no_external_references(page: str) -> None:
    elements = Elements(page)
    external_values = [value for name, value in elements.attributes if "//" in value and not name.startswith("xmlns")]
    assert external_values == []
    assert not {"script", "iframe", "object", "img"} & set(elements.tags)


@pytest.mark.parametrize("name", ["report.pdf", "figure.SVG"])
def test_a_page_is_not_written_to_a_file_of_another_format(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert main(["report", str(tables.write(tmp_path, lawns.lawn(2))), "-o", str(tmp_path / name)]) == 2
    assert "a report is a page of HTML" in capsys.readouterr().err
    assert not (tmp_path / name).exists()
