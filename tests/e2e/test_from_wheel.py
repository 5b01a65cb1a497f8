"""What a wheel installs: pages for `fieldkit docs`, which needs no network, and the plugin for pytest."""

import shutil
import subprocess
from pathlib import Path

import pytest
from playwright.sync_api import Request, sync_playwright

from tests.helpers import site_links, suites, wheels
from tests.helpers.paths import ROOT

pytestmark = pytest.mark.emulated

EXAMPLE = ROOT / "docs" / "examples" / "teleop"
"""The example suite of docs/pytest.md."""


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return wheels.install_wheel(tmp_path_factory.mktemp("wheel"))


def page(python: Path, topic: str) -> Path:
    """Return the path printed by `fieldkit docs TOPIC --path`."""
    command = (python.with_name("fieldkit"), "docs", topic, "--path")
    process = subprocess.run(command, cwd=python.parent, capture_output=True, text=True, check=True)
    return Path(process.stdout.strip())


@pytest.mark.parametrize(
    ("topic", "text"),
    [
        ("field", "Real robots"),
        ("steps", "Sends a file with netcat"),
        ("trial", "fieldkit trial"),
        ("errors", "remedy"),
    ],
)
def test_a_topic_is_an_installed_page_about_it(python: Path, topic: str, text: str) -> None:
    path = page(python, topic)
    assert path.is_relative_to(python.parents[1])
    assert text in path.read_text(encoding="utf-8")


def test_every_link_leads_to_an_installed_page(python: Path) -> None:
    assert site_links.broken_links(page(python, "index").parent) == []


def test_search_works_from_files(python: Path) -> None:
    requested: list[str] = []

    def record_request(request: Request) -> None:
        requested.append(request.url)

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        tab = browser.new_context(offline=True, viewport={"width": 1300, "height": 900}).new_page()
        tab.on("request", record_request)
        tab.goto(page(python, "index").as_uri())
        tab.click(".md-search__input")
        tab.keyboard.type("netcat")
        tab.wait_for_selector(".md-search-result__item")
        browser.close()
    assert not [url for url in requested if not url.startswith(("file:", "data:", "about:", "blob:"))]


@pytest.fixture
def example(tmp_path: Path) -> Path:
    """The example after a user has copied it."""
    return Path(shutil.copytree(EXAMPLE, tmp_path / "teleop", ignore=shutil.ignore_patterns("__pycache__")))


def test_the_example_passes(python: Path, example: Path) -> None:
    where = subprocess.run(
        (python, "-c", "import fieldkit; print(fieldkit.__file__)"), cwd=example, capture_output=True, check=True
    )
    assert Path(where.stdout.decode().strip()).is_relative_to(python.parents[1])
    done = suites.run(example, python=str(python), import_folders=())
    assert (done.code, set(done.results.values()), len(done.results)) == (0, {"passed"}, 3), done.output
    assert not (example / "fieldkit-results").exists()


def test_the_sources_of_programs_in_cpp_are_installed(python: Path) -> None:
    (packages,) = (python.parents[1] / "lib").glob("python*/site-packages")
    sources, installed = (
        {
            path.relative_to(root).as_posix()
            for path in (root / "sim_backends").rglob("*")
            if path.suffix in {".cc", ".h"}
        }
        for root in (ROOT, packages)
    )
    assert "sim_backends/federates/cpp/fieldkit/frames.h" in installed
    assert installed == sources
