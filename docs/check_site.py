"""Looks at every page of the built site in a browser without a screen, from the disk, at the width of a laptop and of a phone:

    make docs && .venv/bin/python docs/check_site.py        # needs chromium, e.g. from Debian's package of that name

It counts elements that stick out of the page or, on a laptop, have to be scrolled sideways; links to files and places that are not there; pictures
that do not load; messages of errors in the browser's console; and tries the search. Links to other sites are not followed.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urldefrag, urlparse

SITE = Path(__file__).parent.parent / "site"
WIDTHS = {"laptop": 1366, "phone": 390}  # pixels
_HEIGHT = 900
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_PATIENCE = 30.0  # seconds

_LOOK = """
(() => {
  const width = document.documentElement.clientWidth;
  const name = e => e.tagName.toLowerCase() + (e.className && e.className.baseVal === undefined ? "." + e.className.trim().split(/\\s+/)[0] : "")
    + ": " + e.textContent.trim().replace(/\\s+/g, " ").slice(0, 60);
  const inside = e => { for (let p = e.parentElement; p && p !== document.body; p = p.parentElement)
    if (getComputedStyle(p).overflowX !== "visible") return true; return false; };
  const outside = [], scrolled = [];
  for (const e of document.querySelectorAll(".md-header *, .md-content *, .md-footer *")) {
    const box = e.getBoundingClientRect(), overflow = getComputedStyle(e).overflowX;
    if (box.width > 0 && box.height > 0 && box.right > width + 1 && getComputedStyle(e).visibility !== "hidden" && !inside(e)) outside.push(name(e));
    if (e.closest(".md-content") && (overflow === "auto" || overflow === "scroll") && e.scrollWidth > e.clientWidth + 1) scrolled.push(name(e));
  }
  return {
    outside, scrolled,
    pictures: [...document.images].filter(i => !i.complete || !i.naturalWidth).map(i => i.getAttribute("src")),
    links: [...document.querySelectorAll("a[href]")].map(a => a.href),
    places: [...document.querySelectorAll("[id], a[name]")].map(e => e.id || e.name),
  };
})()
"""

_SEARCH = """
new Promise(done => {
  const field = document.querySelector("input.md-search__input");
  document.querySelector("#__search").click();
  field.focus();
  field.value = WORD;
  field.dispatchEvent(new Event("input", {bubbles: true}));
  field.dispatchEvent(new KeyboardEvent("keyup", {bubbles: true}));
  const began = Date.now(), look = () => {
    const found = document.querySelectorAll(".md-search-result__item").length;
    if (found || Date.now() - began > PATIENCE) done(found); else setTimeout(look, 100);
  };
  look();
})
"""


class Browser:
    """A browser without a screen, spoken to over a pair of pipes in the DevTools protocol."""

    def __init__(self, program: str, profile: str) -> None:
        to_browser, self._write = os.pipe()
        self._read, from_browser = os.pipe()
        os.set_inheritable(to_browser, True)
        os.set_inheritable(from_browser, True)
        options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars", f"--user-data-dir={profile}"]
        # The protocol's pipes are descriptors 3 and 4 of the browser.
        command = f'exec "$@" 3<&{to_browser} 4>&{from_browser}'
        self._process = subprocess.Popen(
            ["bash", "-c", command, "bash", program, *options, "--remote-debugging-pipe", "about:blank"],
            pass_fds=(to_browser, from_browser),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser)
        os.close(from_browser)
        self._numbers, self._buffer = itertools.count(1), b""
        self.events: list[dict[str, Any]] = []
        self._session: str | None = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> Any:
        """Calls a method of the protocol; what the browser reports meanwhile is added to `events`."""
        number = next(self._numbers)
        message: dict[str, Any] = {"id": number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        return self._wait(lambda answer: answer.get("id") == number)["result"]

    def resize(self, width: int, height: int) -> None:
        """Makes the window as large as this many pixels, and waits until the page has been drawn anew."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.evaluate("new Promise(done => { requestAnimationFrame(() => requestAnimationFrame(done)); setTimeout(done, 1000); })")

    def open(self, address: str) -> None:
        """Shows a page, and waits until it is loaded."""
        self.events.clear()
        self.call("Page.navigate", url=address)
        if not any(event.get("method") == "Page.loadEventFired" for event in self.events):
            self._wait(lambda answer: answer.get("method") == "Page.loadEventFired")

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression, or of what its promise becomes."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(str(answer["exceptionDetails"]))
        return answer["result"].get("value")

    def errors(self) -> list[str]:
        """What the page that is open has complained of."""
        found = []
        for event in self.events:
            method, given = event.get("method"), event.get("params", {})
            if method == "Runtime.exceptionThrown":
                found.append(str(given["exceptionDetails"].get("exception", given["exceptionDetails"]).get("description", given)))
            elif method == "Runtime.consoleAPICalled" and given["type"] == "error":
                found.append(" ".join(str(one.get("value", one.get("description"))) for one in given["args"]))
            elif method == "Log.entryAdded" and given["entry"]["level"] == "error":
                found.append(f"{given['entry']['text']} {given['entry'].get('url', '')}")
        return found

    def close(self) -> None:
        """Ends the browser."""
        self._process.terminate()
        self._process.wait(timeout=_PATIENCE)
        os.close(self._write)
        os.close(self._read)

    def _wait(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        ends = time.monotonic() + _PATIENCE
        while time.monotonic() < ends:
            while b"\0" in self._buffer:
                text, self._buffer = self._buffer.split(b"\0", 1)
                answer = json.loads(text)
                if "id" not in answer:
                    self.events.append(answer)
                if wanted(answer):
                    if "error" in answer:
                        raise RuntimeError(str(answer["error"]))
                    return answer
            piece = os.read(self._read, 1 << 20)
            if not piece:
                raise RuntimeError("the browser has ended")
            self._buffer += piece
        raise TimeoutError("the browser does not answer")


@dataclasses.dataclass
class Report:
    """What is wrong with the site; each entry says where."""

    pages: int = 0
    overflowing: list[str] = dataclasses.field(default_factory=list)
    dead_links: list[str] = dataclasses.field(default_factory=list)
    missing_pictures: list[str] = dataclasses.field(default_factory=list)
    console_errors: list[str] = dataclasses.field(default_factory=list)
    search_results: int = 0

    def lines(self) -> list[str]:
        """A line of figures, and one for each thing that is wrong."""
        figures = ", ".join(f"{name.replace('_', ' ')} {len(found)}" for name, found in self._lists())
        return [f"{self.pages} pages: {figures}; search from disk finds {self.search_results}", *(one for _, found in self._lists() for one in found)]

    def is_good(self) -> bool:
        """Whether nothing is wrong."""
        return self.pages > 0 and self.search_results > 0 and not any(found for _, found in self._lists())

    def _lists(self) -> list[tuple[str, list[str]]]:
        return [(field.name, getattr(self, field.name)) for field in dataclasses.fields(self) if isinstance(getattr(self, field.name), list)]


def find_browser() -> str | None:
    """The program, if one is installed."""
    return next((found for name in BROWSERS if (found := shutil.which(name))), None)


def check(
    site: Path, program: str, *, word: str = "epsilon", patience: float = 15.0, only: Sequence[str] = (), pictures: Path | None = None
) -> Report:
    """Looks at all pages of a site.

    Args:
      site: its folder.
      program: the browser.
      word: what to search for.
      patience: seconds to wait for what is found.
      only: names of pages to look at; all by default.
      pictures: a folder for a picture of each page at each width.
    """
    report, links, places = Report(), {}, {}
    site = site.resolve()
    pages = [path for path in sorted(site.rglob("*.html")) if path.name != "404.html" and (not only or path.relative_to(site).as_posix() in only)]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        browser = Browser(program, profile)
        try:
            for page in pages:
                name = page.relative_to(site).as_posix()
                report.pages += 1
                browser.resize(WIDTHS["laptop"], _HEIGHT)
                browser.open(page.as_uri())
                for device, width in WIDTHS.items():
                    browser.resize(width, _HEIGHT)
                    seen = browser.evaluate(_LOOK)
                    report.overflowing += [f"{name}, {device}: outside the page: {one}" for one in seen["outside"]]
                    if device == "laptop":
                        report.overflowing += [f"{name}, {device}: has to be scrolled: {one}" for one in seen["scrolled"]]
                    if pictures is not None:
                        _save_picture(browser, width, pictures / f"{name.replace('/', '_')}_{device}.png")
                report.missing_pictures += [f"{name}: {one}" for one in seen["pictures"]]
                report.console_errors += [f"{name}: {one}" for one in browser.errors()]
                links[name], places[page] = seen["links"], set(seen["places"])
            if pages:
                browser.resize(WIDTHS["laptop"], _HEIGHT)
                browser.open((site / "index.html").as_uri())
                report.search_results = browser.evaluate(_SEARCH.replace("WORD", json.dumps(word)).replace("PATIENCE", str(1000 * patience)))
        finally:
            browser.close()
    report.dead_links = [f"{name}: {link}" for name, found in links.items() for link in sorted(set(found)) if _is_dead(link, places, bool(only))]
    return report


def _is_dead(link: str, places: dict[Path, set[str]], partly: bool) -> bool:
    address, place = urldefrag(link)
    if urlparse(address).scheme != "file":
        return False
    path = Path(unquote(urlparse(address).path))
    if not path.is_file():
        return True
    return bool(place) and path in places and unquote(place) not in places[path] and not place.startswith("__") and not partly


def _save_picture(browser: Browser, width: int, path: Path) -> None:
    import base64

    height = min(int(browser.evaluate("document.documentElement.scrollHeight")), 6000)
    clip = dict(x=0, y=0, width=width, height=height, scale=1)
    path.write_bytes(base64.b64decode(browser.call("Page.captureScreenshot", captureBeyondViewport=True, clip=clip)["data"]))


def main() -> None:
    """Prints what is wrong; exit code 1 if anything is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--site", type=Path, default=SITE, help="folder of the built site")
    parser.add_argument("--pictures", type=Path, help="also save a picture of each page here")
    parser.add_argument("only", nargs="*", help="pages to look at, for example index.html (default: all)")
    given = parser.parse_args()
    program = find_browser()
    if program is None:
        sys.exit(f"no browser is installed: one of {', '.join(BROWSERS)}")
    if given.pictures is not None:
        given.pictures.mkdir(parents=True, exist_ok=True)
    report = check(given.site, program, only=given.only, pictures=given.pictures)
    print("\n".join(report.lines()))
    sys.exit(not report.is_good())


if __name__ == "__main__":
    main()
