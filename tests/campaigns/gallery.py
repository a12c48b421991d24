"""The gallery in a real headless Chromium: filter, search, sort, open, copy, play, keyboard, themes.

Builds a site of one robot and category, opens it as files and from a local server, and fails on any
request that leaves it, any error on the console, and any deed of a visitor that does not work.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright

from imujoco_minari.pictures.gallery import build
from imujoco_minari.variants import Variant, catalogue

FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
LEG = "hopper-lengthinc_50_leggeom"


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        pass

    def copyfile(self, source: Any, outputfile: Any) -> None:
        # A browser that has seen enough of a clip hangs up.
        with suppress(BrokenPipeError, ConnectionResetError):
            super().copyfile(source, outputfile)


@contextmanager
def server(folder: Path) -> Iterator[str]:
    served = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    threading.Thread(target=served.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{served.server_port}"
    finally:
        served.shutdown()


def visit(browser: Browser, root: str, **options: Any) -> tuple[Page, list[str]]:
    """Open a page whose foreign requests and console errors are gathered."""
    wrong: list[str] = []
    context = browser.new_context(viewport={"width": 1200, "height": 850}, **options)
    page = context.new_page()

    def on_request(request: Any) -> None:
        if not request.url.startswith((root, "data:", "blob:")):
            wrong.append(f"request to {request.url}")

    page.on("request", on_request)

    def on_failure(request: Any) -> None:
        # A visitor who goes on before all has arrived cancels the rest.
        if request.failure != "net::ERR_ABORTED":
            wrong.append(f"failed: {request.url} {request.failure}")

    page.on("requestfailed", on_failure)
    page.on("console", lambda message: message.type == "error" and wrong.append(message.text))
    page.on("pageerror", lambda error: wrong.append(str(error)))
    return page, wrong


def shown(page: Page) -> list[str]:
    return page.locator("li.card:visible .name").all_inner_texts()


def count(page: Page) -> str:
    return page.locator("#count").inner_text()


def filters(page: Page, root: str, total: int) -> None:
    everything = f"{total - 1} of {total - 1} variants, 1 of 1 bases"
    page.goto(f"{root}/index.html")
    assert count(page) == everything, count(page)
    page.get_by_label("Category").select_option("length")
    assert count(page) == f"8 of {total - 1} variants, 0 of 1 bases", count(page)
    page.get_by_label("Percent").select_option("50")
    assert len(shown(page)) == 4
    page.get_by_label("Body").select_option("leggeom")
    assert shown(page) == [LEG]
    assert "body=leggeom" in page.url
    page.reload()
    assert shown(page) == [LEG], "the filters are lost on reload"
    page.get_by_role("button", name="Clear").click()
    page.wait_for_function(f"document.getElementById('count').textContent === '{everything}'")
    page.get_by_label("Robot").select_option("hopper")
    assert count(page) == everything
    # A choice that nothing is left of is not offered.
    page.get_by_label("Category").select_option("friction")
    assert page.locator("select[name=percent] option[value='200']").is_disabled()
    page.get_by_role("button", name="Clear").click()


def search(page: Page, root: str, total: int) -> None:
    page.goto(f"{root}/index.html#")
    box = page.get_by_role("searchbox")
    box.fill("TORSO +50")
    assert sorted(shown(page)) == ["hopper-lengthinc_50_torsogeom", "hopper-massinc_50_torsogeom"], shown(
        page
    )
    box.fill("leggeom -25")
    assert sorted(shown(page)) == ["hopper-lengthdec_25_leggeom", "hopper-massdec_25_leggeom"], shown(page)
    box.fill("a unicorn")
    assert shown(page) == []
    assert page.locator("#none").is_visible()
    box.fill("")
    assert len(shown(page)) == total


def sort(page: Page, root: str) -> None:
    page.goto(f"{root}/index.html#")

    def returns() -> list[float]:
        return [
            float(card.get_attribute("data-return") or "nan")
            for card in page.locator("li.card:visible").all()
        ]

    page.get_by_label("Sort by").select_option("high")
    assert returns() == sorted(returns(), reverse=True)
    page.get_by_label("Sort by").select_option("low")
    assert returns() == sorted(returns())
    page.get_by_label("Sort by").select_option("high-normalised")
    assert (
        shown(page)[0]
        == max(
            page.locator("li.card:visible").all(),
            key=lambda card: float(card.get_attribute("data-normalised") or -9),
        )
        .locator(".name")
        .inner_text()
    )
    page.get_by_label("Sort by").select_option("name")
    assert shown(page) == sorted(shown(page))
    page.get_by_label("Sort by").select_option("")
    assert shown(page)[0] == "hopper-base"


def open_and_return(page: Page, root: str) -> None:
    page.goto(f"{root}/index.html#category=length")
    page.locator("li.card:visible", has_text=LEG).get_by_role("link").click()
    page.wait_for_url(f"**/variants/{LEG}.html")
    assert page.get_by_role("heading", level=1).inner_text() == LEG
    assert page.get_by_role("row", name="length of leg_geom 0.5 0.75 m").count() == 1
    page.get_by_role("link", name="Next: ").first.click()
    assert page.url.endswith("hopper-lengthdec_25_footgeom.html"), page.url
    page.go_back()
    page.get_by_role("link", name="All variants").click()
    page.wait_for_url("**/index.html#category=length")
    assert len(shown(page)) == 8, "the filters are lost on the way back"


def copy(page: Page, root: str) -> None:
    page.goto(f"{root}/variants/{LEG}.html")
    wanted = page.locator("section.code", has_text="Load the dataset").locator("code").inner_text()
    assert "minari.load_dataset(" in wanted
    page.get_by_role("button", name="Copy: Load the dataset").click()
    page.wait_for_function("document.getElementById('said').textContent === 'Copied to the clipboard'")
    page.evaluate(
        "document.body.insertAdjacentHTML('beforeend', '<textarea id=pasted></textarea>');"
        "document.getElementById('pasted').focus()"
    )
    page.keyboard.press("Control+V")
    assert page.locator("#pasted").input_value() == wanted, "what is pasted is not what was shown"


def play(page: Page, root: str) -> None:
    page.goto(f"{root}/variants/{LEG}.html")
    page.get_by_role("button", name="Play both").click()
    page.wait_for_function(
        "[...document.querySelectorAll('video')].every(v => v.readyState >= 2 && v.currentTime > 0.1)",
        timeout=20_000,
    )
    states = page.evaluate(
        "[...document.querySelectorAll('video')].map(v => [v.paused, v.error, v.videoWidth, v.videoHeight])"
    )
    assert states == [[False, None, 320, 240]] * 2, states


def keyboard(page: Page, root: str) -> None:
    page.goto(f"{root}/index.html#")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.closest('.card') !== null")
    page.keyboard.press("Enter")
    page.wait_for_url("**/variants/hopper-base.html")


def themes(browser: Browser, root: str, pictures: Path | None) -> None:
    for scheme in ("light", "dark"):
        page, wrong = visit(browser, root, color_scheme=scheme)
        page.goto(f"{root}/index.html")
        for text, behind in (
            ("--ink", "--paper"),
            ("--faint", "--card"),
            ("--mass", "--card"),
            ("--link", "--card"),
        ):
            ratio = page.evaluate(CONTRAST, [text, behind])
            assert ratio >= 4.5, f"{scheme}: {text} on {behind} has a contrast of {ratio:.2f}"
        before = page.evaluate("getComputedStyle(document.body).backgroundColor")
        page.wait_for_timeout(500)
        _picture(page, pictures, f"index-{scheme}")
        page.get_by_role("button", name="Dark or light").click()
        after = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert before != after
        page.goto(f"{root}/variants/{LEG}.html")
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == after, (
            "the theme is forgotten"
        )
        _picture(page, pictures, f"variant-{'dark' if scheme == 'light' else 'light'}")
        page.set_viewport_size({"width": 360, "height": 740})
        for place in ("index.html", f"variants/{LEG}.html"):
            page.goto(f"{root}/{place}")
            assert page.evaluate("document.documentElement.scrollWidth") <= 360, (
                f"{place} is wider than a phone"
            )
            assert page.evaluate(BROKEN_WORDS) == [], "a heading breaks within a word"
            _picture(page, pictures, f"phone-{Path(place).stem}-{'dark' if scheme == 'light' else 'light'}")
        assert wrong == [], wrong
        page.context.close()


# The words of headings, cut at their break points, that are drawn in more than one line.
BROKEN_WORDS = """() => [...document.querySelectorAll("h1, h2, h3, .name")].flatMap((heading) => {
  const broken = [];
  const walker = document.createTreeWalker(heading, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    for (const word of walker.currentNode.data.matchAll(/[^ -]+-?/g)) {
      const range = document.createRange();
      range.setStart(walker.currentNode, word.index);
      range.setEnd(walker.currentNode, word.index + word[0].length);
      const lines = new Set([...range.getClientRects()].map((box) => Math.round(box.top)));
      if (lines.size > 1) broken.push(word[0]);
    }
  }
  return broken;
})"""
CONTRAST = """([text, behind]) => {
  const light = (name) => {
    const probe = document.createElement("i");
    probe.style.color = `var(${name})`;
    document.body.append(probe);
    const parts = getComputedStyle(probe).color.match(/[0-9.]+/g).slice(0, 3).map((part) => part / 255);
    probe.remove();
    const [r, g, b] = parts.map((c) => (c <= 0.03928 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const [a, b] = [light(text), light(behind)].sort((x, y) => y - x);
  return (a + 0.05) / (b + 0.05);
}"""


def without_javascript(browser: Browser, root: str, total: int) -> None:
    page, wrong = visit(browser, root, java_script_enabled=False)
    page.goto(f"{root}/index.html")
    assert len(shown(page)) == total
    assert wrong == [], wrong
    page.context.close()


def weigh(browser: Browser, root: str) -> dict[str, float]:
    """Return what a first visit loads and how long it takes until the filters work."""
    page, wrong = visit(browser, root)
    sizes: list[int] = []
    page.on("response", lambda response: sizes.append(int(response.headers.get("content-length", 0))))
    start = time.monotonic()
    page.goto(f"{root}/index.html", wait_until="domcontentloaded")
    page.get_by_label("Category").select_option("mass")
    page.wait_for_function("document.getElementById('count').textContent.startsWith('20 of')")
    first_use = time.monotonic() - start
    page.wait_for_load_state("networkidle")
    index = sum(sizes)
    sizes.clear()
    page.goto(f"{root}/variants/{LEG}.html")
    page.wait_for_load_state("networkidle")
    assert wrong == [], wrong
    page.context.close()
    return {"first_use_s": first_use, "index_kB": index / 1000, "variant_kB": sum(sizes) / 1000}


def _picture(page: Page, folder: Path | None, name: str) -> None:
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        page.screenshot(path=folder / f"{name}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--site", type=Path, help="a gallery with all Hoppers to test, instead of a new one")
    parser.add_argument("--pictures", type=Path, help="keep screenshots in this folder")
    parser.add_argument("--chromium", default=shutil.which("chromium") or shutil.which("chromium-browser"))
    arguments = parser.parse_args()
    if arguments.chromium is None:
        raise SystemExit("no Chromium: `apt-get install chromium`, or name one with --chromium")
    with tempfile.TemporaryDirectory() as temporary:
        site = arguments.site or Path(temporary) / "site"
        start = time.monotonic()
        built = build(site, catalogue("hopper"))
        print(f"{built.variants} variants, {built.drawn} drawn, in {time.monotonic() - start:.0f} s")
        with sync_playwright() as playwright, server(site) as address:
            browser = playwright.chromium.launch(executable_path=arguments.chromium, args=list(FLAGS))
            for root in (site.resolve().as_uri(), address):
                total = built.variants
                for deed in (
                    lambda page, root=root, total=total: filters(page, root, total),
                    lambda page, root=root, total=total: search(page, root, total),
                    lambda page, root=root: sort(page, root),
                    lambda page, root=root: open_and_return(page, root),
                    lambda page, root=root: copy(page, root),
                    lambda page, root=root: play(page, root),
                    lambda page, root=root: keyboard(page, root),
                ):
                    page, wrong = visit(browser, root)
                    deed(page)
                    assert wrong == [], wrong
                    page.context.close()
                themes(browser, root, arguments.pictures)
                without_javascript(browser, root, total)
                print(
                    f"{root.partition(':')[0]}: filter, search, sort, open, copy, play, keyboard, themes work"
                )
            weight = weigh(browser, address)
            print(", ".join(f"{name} {value:.2f}" for name, value in weight.items()))
            assert weight["first_use_s"] < 2.0
            browser.close()


assert Variant.parse(LEG) in catalogue("hopper", "length")

if __name__ == "__main__":
    main()
