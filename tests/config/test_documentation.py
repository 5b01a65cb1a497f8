"""Documentation pages by topic, in a wheel and in a checkout."""

from pathlib import Path

import pytest

from fieldkit.config import documentation
from fieldkit.core.errors import ConfigurationError
from tests.helpers.paths import ROOT


@pytest.fixture
def installed_docs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of the pages in an installed package."""
    docs = tmp_path / "fieldkit" / "data" / "docs"
    for name in ("index", "404", "field", "reference/index", "reference/commands", "studies/mesh"):
        page = docs / f"{name}.html"
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text('<a href="#fieldkit-trial">trial</a>', encoding="utf-8")
    monkeypatch.setattr(documentation, "_PACKAGE", tmp_path / "fieldkit")
    return docs


def test_topics_are_pages_of_all_folders(installed_docs: Path) -> None:
    assert documentation.topics() == {
        "commands": installed_docs / "reference" / "commands.html",
        "field": installed_docs / "field.html",
        "index": installed_docs / "index.html",
        "mesh": installed_docs / "studies" / "mesh.html",
        "reference": installed_docs / "reference" / "index.html",
    }


def test_a_checkout_has_its_markdown_pages() -> None:
    assert documentation.find("field").path == ROOT / "docs" / "field.md"
    assert documentation.find("steps").path == ROOT / "docs" / "reference" / "steps.md"


def test_command_is_a_section_of_the_command_reference(installed_docs: Path) -> None:
    page = documentation.find("trial")
    assert page.uri == (installed_docs / "reference" / "commands.html").as_uri() + "#fieldkit-trial"


@pytest.mark.usefixtures("installed_docs")
def test_unknown_topic_suggests_the_nearest() -> None:
    with pytest.raises(ConfigurationError, match="no topic 'fields'") as error_info:
        documentation.find("fields")
    assert error_info.value.remedy == "did you mean 'field'?"


def test_package_without_pages_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(documentation, "_PACKAGE", tmp_path / "fieldkit")
    with pytest.raises(ConfigurationError, match="has no documentation"):
        documentation.topics()
