"""A report opened in Chromium, with a record of its console messages and requests."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from playwright.sync_api import Browser, Page, Route, sync_playwright

PHONE = 390
LAPTOP = 1280
"""Widths of a page in pixels."""
TIMEOUT_MS = 120_000
"""Time limit of each wait on a busy machine."""


@dataclass
class OpenedPage:
    """An open page, its console messages, and the URLs that it requested besides the URL of its file."""

    page: Page
    console_messages: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)


@contextmanager
def chromium() -> Iterator[Browser]:
    """Yield a headless Chromium of the Debian package."""
    with sync_playwright() as tools:
        browser = tools.chromium.launch(
            executable_path="/usr/bin/chromium", args=["--no-sandbox"], timeout=TIMEOUT_MS
        )
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def opened(
    browser: Browser, path: Path, *, width: int = LAPTOP, scheme: Literal["light", "dark"] = "light"
) -> Iterator[OpenedPage]:
    """Yield a page opened from a file; all other requests are rejected."""
    context = browser.new_context(viewport={"width": width, "height": 844}, color_scheme=scheme)
    context.set_default_timeout(TIMEOUT_MS)
    opened_page = OpenedPage(context.new_page())

    def filter_request(route: Route) -> None:
        if route.request.url == path.as_uri():
            route.continue_()
        else:
            opened_page.requests.append(route.request.url)
            route.abort()

    context.route("**/*", filter_request)
    opened_page.page.on("console", lambda message: opened_page.console_messages.append(message.text))
    opened_page.page.on("pageerror", lambda error: opened_page.console_messages.append(str(error)))
    opened_page.page.on("dialog", lambda dialog: opened_page.console_messages.append(f"dialog: {dialog.message}"))
    opened_page.page.goto(path.as_uri())
    yield opened_page
    context.close()
