"""Reports of emulated trials and of synthetic tables, opened in Chromium."""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest
from playwright.sync_api import Browser

from tests.helpers import lawns, tables
from tests.helpers.browser import LAPTOP, PHONE, chromium, opened
from tests.helpers.labs import built_in_ros
from tests.helpers.runs import only_trial, run_here

pytestmark = pytest.mark.emulated

A4 = 720
"""Width of the page inside its margins, in CSS pixels."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as chromium_browser:
        yield chromium_browser


@pytest.fixture(scope="module")
def lawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The path of a report of synthetic trials."""
    folder = tmp_path_factory.mktemp("lawn")
    tables.write(folder, [*lawns.lawn(), *rows_without_reply()], "all.csv")
    run = run_here(folder, "report", "all.csv")
    assert run.code == 0, run.err
    return folder / "report.html"


def rows_without_reply() -> list[tables.RepeatRow]:
    """Return repeats behind the wall in which no packet arrived."""
    lost = {"datagrams_received": 0, "datagram_loss": 1.0, "rtt_median_s": None, "transfer_s": None}
    place = {"scenario": "nlos", "procedure": "nlos", "distance": "60m", "distance_m": 60.0, "trial": "dead"}
    return [lawns.row(number, **place, **lost) for number in (1, 2, 3)]


@pytest.mark.parametrize("width", [PHONE, LAPTOP])
def test_missing_data_is_visible_in_headlines_and_curves(browser: Browser, lawn: Path, width: int) -> None:
    with opened(browser, lawn, width=width) as opened_page:
        first = opened_page.page.locator(".headlines .missing strong").nth(1)
        assert first.is_visible()
        assert first.inner_text() == "nothing arrived in 3 repeats"
        cross = opened_page.page.locator("#rtt-median svg text", has_text="nothing arrived: 3 of 3").first
        assert cross.is_visible()
        assert cross.bounding_box() is not None


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [PHONE, LAPTOP])
def test_all_figures_are_visible_on_phone_and_laptop(
    browser: Browser, lawn: Path, width: int, scheme: Literal["light", "dark"]
) -> None:
    with opened(browser, lawn, width=width, scheme=scheme) as opened_page:
        assert opened_page.console_messages == []
        assert opened_page.requests == []
        figures = opened_page.page.locator("figure")
        names = [figure.get_attribute("id") for figure in figures.all()]
        assert {"datagram-loss", "tcp-byte-loss", "rtt-median", "transfer", "rtt-distribution"} <= set(names)
        for panel in opened_page.page.locator("figure .panels > svg").all():
            box = panel.bounding_box()
            assert panel.is_visible()
            assert box is not None
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= width
            assert box["height"] > 100
        assert opened_page.page.evaluate("document.documentElement.scrollWidth") == width


def test_printed_tables_fit_the_page_and_charts_are_not_reduced(browser: Browser, lawn: Path) -> None:
    with opened(browser, lawn, width=A4) as opened_page:
        opened_page.page.emulate_media(media="print")
        for table in opened_page.page.locator(".scroll > table").all():
            box = table.bounding_box()
            assert box is None or box["x"] + box["width"] <= A4, table.inner_text()
        for panel in opened_page.page.locator(".panels:not(.dense) > svg").all():
            box = panel.bounding_box()
            assert box is not None
            assert box["width"] > A4 / 3


def test_text_contrast_in_dark_and_light_scheme(browser: Browser, lawn: Path) -> None:
    for scheme in ("light", "dark"):
        with opened(browser, lawn, scheme=scheme) as opened_page:
            assert contrast(opened_page.page.evaluate(PAINT, "p:not(.note)")) >= 7
            assert contrast(opened_page.page.evaluate(PAINT, ".note")) >= 4.5
            assert contrast(opened_page.page.evaluate(PAINT, "figure svg text")) >= 7


PAINT = """selector => {
  const ink = getComputedStyle(document.querySelector(selector));
  const paper = getComputedStyle(document.body).backgroundColor;
  return [selector.includes("svg") ? ink.fill : ink.color, paper].map(c => c.match(/[0-9.]+/g).map(Number));
}"""


def contrast(colours: tuple[list[float], list[float]]) -> float:
    """Return the contrast of two colours (WCAG 2.2, relative luminance)."""
    first, second = (luminance(colour) for colour in colours)
    return (max(first, second) + 0.05) / (min(first, second) + 0.05)


def luminance(colour: list[float]) -> float:
    linear = [c / 255 / 12.92 if c / 255 <= 0.04045 else ((c / 255 + 0.055) / 1.055) ** 2.4 for c in colour[:3]]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_report_of_an_emulated_trial_links_to_its_evidence(browser: Browser, tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    run = run_here(tmp_path, "trial", "los", "30ft", "--repeats", "2", "--record", "1s", "--protocol", "udp")
    assert run.code == 0, run.err
    run = run_here(tmp_path, "report", "trials", "--rebuild")
    assert run.code == 0, run.err
    with opened(browser, tmp_path / "report.html") as opened_page:
        assert opened_page.console_messages == opened_page.requests == []
        names = [figure.get_attribute("id") for figure in opened_page.page.locator("figure").all()]
        assert "timeline" in names
        assert opened_page.page.locator("svg.raster").count() == 1
        boxes = [panel.bounding_box() for panel in opened_page.page.locator(".stacked > svg").all()]
        assert len(boxes) >= 3
        assert len({(box["x"], box["width"]) for box in boxes if box}) == 1, "all panels have the same time axis"
        links = [link.get_attribute("href") or "" for link in opened_page.page.locator("a.mark").all()]
    trial = only_trial(tmp_path).relative_to(tmp_path)
    assert links == [f"{trial}/repeats/udp-0{number}/" for number in (1, 2)]
    assert all((tmp_path / link / "sender.pcap").is_file() for link in links)
