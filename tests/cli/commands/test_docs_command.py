"""The command `fieldkit docs`: it opens a page, prints its path, or lists all pages."""

import webbrowser

import pytest

from fieldkit.cli import main
from tests.helpers.paths import ROOT

FIELD = ROOT / "docs" / "field.md"


@pytest.fixture
def opened_addresses(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the list of addresses passed to the browser."""
    addresses: list[str] = []

    def open_address(address: str) -> bool:
        addresses.append(address)
        return True

    monkeypatch.setattr(webbrowser, "open", open_address)
    return addresses


def test_a_topic_is_opened_in_the_browser(opened_addresses: list[str]) -> None:
    assert main(["docs", "field"]) == 0
    assert opened_addresses == [FIELD.as_uri()]


def test_overview_is_opened_by_default(opened_addresses: list[str]) -> None:
    assert main(["docs"]) == 0
    assert opened_addresses == [(ROOT / "docs" / "index.md").as_uri()]


def test_the_path_is_printed_and_no_browser_opened(
    opened_addresses: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["docs", "field", "--path"]) == 0
    assert (capsys.readouterr().out, opened_addresses) == (f"{FIELD}\n", [])


def test_topics_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["docs", "--list"]) == 0
    listed_topics = {line.split()[0] for line in capsys.readouterr().out.splitlines() if line.split()}
    assert {"field", "errors", "reference", "steps"} <= listed_topics


def test_path_is_shown_if_no_browser_is_available(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(webbrowser, "open", lambda address: False)
    assert main(["docs", "field"]) == 2
    assert str(FIELD) in capsys.readouterr().err.replace("\n", "")
