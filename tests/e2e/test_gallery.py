"""benchmarks.studies.gallery generates the pictures of docs/gallery.md."""

from pathlib import Path

import pytest

from benchmarks.studies import gallery
from tests.helpers.paths import ROOT

PICTURES = ROOT / "docs" / "gallery"


def test_the_page_shows_every_picture() -> None:
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    names = {f"{shot.name}.png" for shot in gallery.SHOTS}
    assert {path.name for path in PICTURES.iterdir()} == names
    assert all(f"(gallery/{name})" in page for name in names)


def test_pictures_are_small() -> None:
    assert [path.name for path in PICTURES.iterdir() if path.stat().st_size > 60_000] == []


@pytest.mark.emulated
def test_the_pictures_can_be_generated_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    assert gallery.main(["--out", str(tmp_path)]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in PICTURES.iterdir())
