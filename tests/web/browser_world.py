"""What tests in a real browser share: how it is started, what a page must not do, and a server for it."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import pytest

from tests.waiting import eventually

if TYPE_CHECKING:
    from playwright.sync_api import Browser, ConsoleMessage, Page, Request

CHROMIUM = shutil.which("chromium-headless-shell") or shutil.which("chromium") or shutil.which("google-chrome")
"""The browser that has no window takes half the CPU time of the one that hides its window."""
BROWSER = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium"),
    pytest.mark.timeout(500),
    # Werkzeug leaves the file of an answer 304 to the garbage collector.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
"""The marks of a module with such tests."""

OPTIONS = (
    *("--no-sandbox", "--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),  # plots in 3D need WebGL, here without a GPU
    *(
        "--disable-gpu-compositing",
        "--disable-gpu-rasterization",
    ),  # which take longer without a GPU
)
DESK = {"width": 1280, "height": 900}
PHONE = {"width": 390, "height": 844}
LOOKS: dict[str, dict[str, Any]] = {
    "light": {"viewport": DESK, "color_scheme": "light"},
    "dark": {"viewport": DESK, "color_scheme": "dark"},
    "phone": {"viewport": PHONE, "color_scheme": "light", "has_touch": True},
}


class Faults:
    """What went wrong on a page: errors of scripts, refused content, and requests that leave the server."""

    def __init__(self, page: Page, server: str) -> None:
        self.found: list[str] = []
        self._server = server
        page.on("console", self._console)
        page.on("pageerror", lambda error: self.found.append(f"script: {error}"))
        page.on("request", self._request)

    def taken(self) -> list[str]:
        """The faults since the last call."""
        taken, self.found = self.found, []
        return taken

    def _console(self, line: ConsoleMessage) -> None:
        lacking_frame = "404" in line.text and "/frames/" in line.location["url"]  # the recording here has no images
        if line.type == "error" and not lacking_frame:
            self.found.append(f"console: {line.text}")

    def _request(self, request: Request) -> None:
        if not request.url.startswith((self._server, "data:", "blob:")):
            self.found.append(f"request to {request.url}")


@contextmanager
def opened(chromium: Browser, server: str, look: str = "light", **more: Any) -> Iterator[tuple[Page, Faults]]:
    """A page of a fresh context, which is closed afterwards. A browser keeps the process of a page that moves on."""
    context = chromium.new_context(**{"base_url": server, **LOOKS[look], **more})
    try:
        page = context.new_page()
        yield page, Faults(page, server)
    finally:
        context.close()


@contextmanager
def faultless(chromium: Browser, server: str, *expected: str, look: str = "light", **more: Any) -> Iterator[Page]:
    """A page of a fresh context; fails unless the faults are ``expected``."""
    with opened(chromium, server, look, **more) as (page, faults):
        yield page
    assert faults.found == list(expected), faults.found


def visit(page: Page, address: str) -> int:
    """Go to an address and wait until its plots are drawn; returns the status of the answer."""
    answer = page.goto(address, wait_until="load")
    tops = itertools.cycle(range(0, page.evaluate("document.documentElement.scrollHeight"), 500))

    def is_drawn() -> bool:
        # Not wait_for_function: that one evaluates text, which our pages forbid.
        if not page.evaluate("document.body.innerText.includes('Loading …')"):
            return True
        page.evaluate(f"scrollTo(0, {next(tops)})")  # some parts load when they come near
        return False

    eventually(is_drawn, f"the plots of {address}")
    page.evaluate("scrollTo(0, 0)")
    return 0 if answer is None else answer.status


def wide_parts(page: Page) -> list[str]:
    """What makes the page scroll sideways, once it has its styles."""
    page.wait_for_load_state("load")
    if not page.evaluate("document.documentElement.scrollWidth > innerWidth"):
        return []
    script = """() => [...document.querySelectorAll('main *')]
        .filter((part) => part.getBoundingClientRect().right > innerWidth + 1)
        .slice(0, 3).map((part) => part.outerHTML.slice(0, 80))"""
    return [f"wider than the window: {part}" for part in page.evaluate(script) or ["something"]]


CONTRAST = "color-contrast"
RULES: dict[str, dict[str, Any]] = {
    "light": {},
    "dark": {"runOnly": [CONTRAST]},
    "phone": {"runOnly": ["scrollable-region-focusable", "meta-viewport", "label", "button-name", "link-name"]},
}
"""The rules of axe-core in each look, all if none is named. What the look does not change is not looked at again."""


def violations(page: Page, look: str = "light") -> list[str]:
    """What axe-core finds, by rule and place."""
    from axe_playwright_python.sync_playwright import Axe  # noqa: PLC0415 - only this tier has it

    page.wait_for_load_state("load")  # without its styles a page has other colours
    rules = Axe().run(page, options={"resultTypes": ["violations"], **RULES[look]}).response["violations"]
    return [
        f"axe {entry['id']}: {node['target']} {node['failureSummary'][:200]}"
        for entry in rules
        for node in entry["nodes"][:3]
    ]
