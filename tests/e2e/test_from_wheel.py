"""The contents of the wheel: the pages of `fieldkit docs`, which need no network, and the plugin for pytest."""

import shutil
import subprocess
from pathlib import Path

import pytest
from playwright.sync_api import Request

from tests.helpers import site_links, suites, wheels
from tests.helpers.browser import TIMEOUT_MS, chromium
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


def test_the_search_of_the_pages_needs_no_server(python: Path) -> None:
    requested_urls: list[str] = []

    def record_request(request: Request) -> None:
        requested_urls.append(request.url)

    with chromium() as browser:
        tab = browser.new_context(offline=True, viewport={"width": 1300, "height": 900}).new_page()
        tab.set_default_timeout(TIMEOUT_MS)
        tab.on("request", record_request)
        tab.goto(page(python, "index").as_uri())
        tab.click(".md-search__input")
        tab.keyboard.type("netcat")
        tab.wait_for_selector(".md-search-result__item")
    assert not [url for url in requested_urls if not url.startswith(("file:", "data:", "about:", "blob:"))]


@pytest.fixture
def example(tmp_path: Path) -> Path:
    """A copy of the example, as a user would make it."""
    return Path(shutil.copytree(EXAMPLE, tmp_path / "teleop", ignore=shutil.ignore_patterns("__pycache__")))


def test_the_example_passes(python: Path, example: Path) -> None:
    import_run = subprocess.run(
        (python, "-c", "import fieldkit; print(fieldkit.__file__)"), cwd=example, capture_output=True, check=True
    )
    assert Path(import_run.stdout.decode().strip()).is_relative_to(python.parents[1])
    suite_run = suites.run(example, python=str(python), import_folders=())
    assert (suite_run.code, set(suite_run.results.values()), len(suite_run.results)) == (0, {"passed"}, 3), (
        suite_run.output
    )
    assert not (example / "fieldkit-results").exists()


def test_the_sources_of_programs_in_cpp_are_installed(python: Path) -> None:
    (packages,) = (python.parents[1] / "lib").glob("python*/site-packages")
    repository_files, installed_files = (
        {
            path.relative_to(root).as_posix()
            for path in (root / "sim_backends").rglob("*")
            if path.suffix in {".cc", ".h"}
        }
        for root in (ROOT, packages)
    )
    assert "sim_backends/federates/cpp/fieldkit/frames.h" in installed_files
    assert installed_files == repository_files
