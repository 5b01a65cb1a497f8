"""A report opened in Chromium, with everything noted that it says and asks for."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from playwright.sync_api import Browser, Page, Route, sync_playwright

PHONE = 390
LAPTOP = 1280
_LONG_MS = 120_000


@dataclass
class Opened:
    """An open page, what its console said, and what it asked for beside its own file."""

    page: Page
    said: list[str] = field(default_factory=list)
    asked_for: list[str] = field(default_factory=list)


@contextmanager
def chromium() -> Iterator[Browser]:
    """Yield Debian's Chromium, without a window."""
    with sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"], timeout=_LONG_MS)
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def opened(
    browser: Browser, path: Path, *, width: int = LAPTOP, scheme: Literal["light", "dark"] = "light"
) -> Iterator[Opened]:
    """Yield a page opened as a file; every request but the one for it is refused."""
    context = browser.new_context(viewport={"width": width, "height": 844}, color_scheme=scheme)
    context.set_default_timeout(_LONG_MS)
    found = Opened(context.new_page())

    def judge(route: Route) -> None:
        if route.request.url == path.as_uri():
            route.continue_()
        else:
            found.asked_for.append(route.request.url)
            route.abort()

    context.route("**/*", judge)
    found.page.on("console", lambda message: found.said.append(message.text))
    found.page.on("pageerror", lambda error: found.said.append(str(error)))
    found.page.on("dialog", lambda dialog: found.said.append(f"dialog: {dialog.message}"))
    found.page.goto(path.as_uri())
    yield found
    context.close()
