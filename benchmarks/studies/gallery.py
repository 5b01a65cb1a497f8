"""Pictures of docs/gallery.md, from stored trials: `python -m benchmarks.studies.gallery [--out docs/gallery]`.

The program writes a report of the trials in `TRIALS` and saves parts of it as pictures with Debian's Chromium. It
needs neither root nor a network.
"""

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from PIL import Image
from playwright.sync_api import Browser, sync_playwright

from fieldkit import cli

TRIALS: Final = Path("tests/data/fieldkit/4/trials")
CHROMIUM: Final = "/usr/bin/chromium"
COLOURS: Final = 32
"""Number of colours of a picture. Figures have few colours, and a palette makes files several times smaller."""
HEIGHT: Final = 900


@dataclass(frozen=True)
class Shot:
    """A picture of a report.

    Attributes:
        name: File name without its ending.
        width: Width of the window in pixels.
        element: CSS selector of the part that is shown; None shows the top of the page.
        scheme: Colour scheme of the page.
    """

    name: str
    width: int = 1000
    element: str | None = None
    scheme: Literal["light", "dark"] = "light"


SHOTS: Final = (
    Shot("top"),
    Shot("top-dark", scheme="dark"),
    Shot("phone", width=390),
    Shot("table", element="section[aria-labelledby=cells]"),
    Shot("distribution", element="#transfer-distribution"),
    Shot("timeline", element="#timeline"),
    Shot("packets", element="#packets"),
)


def save_shot(browser: Browser, report: Path, shot: Shot, folder: Path) -> Path:
    """Save a part of a report as a picture; return the file."""
    path = folder / f"{shot.name}.png"
    context = browser.new_context(viewport={"width": shot.width, "height": HEIGHT}, color_scheme=shot.scheme)
    try:
        page = context.new_page()
        page.goto(report.as_uri())
        if shot.element is None:
            page.screenshot(path=path)
        else:
            page.locator(shot.element).first.screenshot(path=path)
    finally:
        context.close()
    with Image.open(path) as picture:
        small = picture.convert("RGB").quantize(COLOURS)
    small.save(path, optimize=True)
    return path


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the report and its pictures, and print their sizes; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/gallery"), help="folder of the pictures")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as tools:
        report = Path(folder) / "report.html"
        code = cli.main(["report", str(TRIALS), "-o", str(report)])
        if code:
            return code
        browser = tools.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        try:
            for shot in SHOTS:
                path = save_shot(browser, report, shot, options.out)
                print(f"{path}: {path.stat().st_size / 1000:.0f} kB")
        finally:
            browser.close()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
