"""Look at every page of the built site in Chromium, wide and on a phone, light and dark.

    pip install -e '.[docs]' playwright && playwright install chromium
    mkdocs build -d SITE && python experiments/site_check.py SITE [--pictures FOLDER]

Reports, for each page: what is wider than its place, words that break within a cell of a table,
missing pictures, requests that leave the site (there must be none), errors of scripts, and text
whose contrast is below what the Web Content Accessibility Guidelines ask (4.5, 3 for large text).
A Chromium of the system is taken where there is one. Exits 1 if there is anything to report.
"""

import argparse
import functools
import shutil
import sys
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

WIDTHS = {"wide": 1440, "phone": 390}
SCHEMES = ("light", "dark")

# What is wrong with a page as it stands, as lines of text.
LOOK = r"""
(wide) => {
  const found = [];
  const say = (what, node) =>
    found.push(`${what}: ${[...(node.innerText || node.src || '').trim()].slice(0, 60).join('')}`);
  const root = document.documentElement;
  if (root.scrollWidth > root.clientWidth) found.push(`page is ${root.scrollWidth} px wide`);
  const article = document.querySelector('article');
  for (const node of article.querySelectorAll('*')) {
    const style = getComputedStyle(node);
    const over = node.scrollWidth > node.clientWidth + 1 && node.clientWidth > 0;
    const scrolls = ['auto', 'scroll'].includes(style.overflowX);
    if (node.closest('math, svg') || style.display === 'inline') continue;
    if (!node.checkVisibility()) continue;
    if (over && !scrolls && style.overflowX === 'hidden') say('cut', node);
    if (over && wide && node.matches('pre > code')) say('code is cut', node);
    if (over && wide && node.matches('.formula')) say('formula is cut', node);
  }
  const canvas = document.createElement('canvas').getContext('2d');
  for (const cell of article.querySelectorAll('td, th')) {
    if (!cell.checkVisibility() || cell.clientWidth < 2) continue;
    const style = getComputedStyle(cell);
    canvas.font = style.font;
    const room = cell.clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight);
    for (const word of cell.innerText.split(/[\s/.,=()\-–—_|\[\]{}:]+/))
      if (canvas.measureText(word).width > room + 2) { say(`breaks "${word}"`, cell); break; }
  }
  for (const image of document.images)
    if (image.complete && image.naturalWidth === 0) say('no picture', image);
  const parts = (colour) => {
    const n = colour.match(/[\d.]+/g).map(Number);
    return colour.startsWith('color(') ? [n[0] * 255, n[1] * 255, n[2] * 255, n[3] ?? 1]
                                       : [n[0], n[1], n[2], n[3] ?? 1];
  };
  const light = ([r, g, b]) => [r, g, b].map((v) => v / 255)
    .map((v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const over = (a, b) => [0, 1, 2].map((i) => a[3] * a[i] + (1 - a[3]) * b[i]).concat(1);
  const behind = (node) => {
    const layers = [];
    for (; node; node = node.parentElement) {
      const colour = parts(getComputedStyle(node).backgroundColor);
      if (colour[3] > 0) layers.push(colour);
      if (colour[3] === 1) break;
    }
    return layers.reverse().reduce((under, layer) => over(layer, under), [255, 255, 255, 1]);
  };
  const pale = new Map();
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode.parentElement;
    const seen = { visibilityProperty: true, opacityProperty: true };
    if (!walker.currentNode.data.trim() || !node.checkVisibility(seen)) continue;
    if (node.closest('.headerlink, script, style, .md-search')) continue;
    if (!node.getClientRects().length) continue;
    const style = getComputedStyle(node);
    const ground = behind(node);
    const values = [light(over(parts(style.color), ground)), light(ground)].sort((a, b) => b - a);
    const ratio = (values[0] + 0.05) / (values[1] + 0.05);
    const size = parseFloat(style.fontSize);
    const large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
    if (ratio < (large ? 3 : 4.5)) {
      const key = `${style.color} on ${ground.slice(0, 3).map(Math.round)}: ${ratio.toFixed(1)}`;
      if (!pale.has(key)) pale.set(key, walker.currentNode.data.trim().slice(0, 40).toWellFormed());
    }
  }
  for (const [key, text] of pale) found.push(`pale, ${key}: ${text}`);
  return found;
}
"""


def pages(site: Path) -> list[str]:
    """Return the addresses of all pages, relative to the site."""
    found = sorted(site.rglob("*.html"))
    return [str(path.relative_to(site)) for path in found if path.name != "404.html"]


def serve(site: Path) -> str:
    """Serve the folder from a thread; return its address."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *arguments: object) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=site))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return f"http://127.0.0.1:{server.server_port}/"


def look(page: Page, url: str, wide: bool, here: str) -> list[str]:
    """Open a page and return what is wrong with it."""
    found: list[str] = []
    asked = lambda request: found.append(f"asks for {request.url}")
    outside = lambda request: (
        None if request.url.startswith((here, "data:", "blob:")) else asked(request)
    )
    failed = lambda error: found.append(f"script: {error}")
    page.on("request", outside)
    page.on("pageerror", failed)
    answer = page.goto(url, wait_until="load")
    assert answer is not None and answer.ok, url
    # Pictures below the fold are loaded when they are near.
    page.evaluate("for (const image of document.images) image.loading = 'eager'")
    page.wait_for_function("[...document.images].every((image) => image.complete)")
    found += page.evaluate(LOOK, wide)
    page.remove_listener("request", outside)
    page.remove_listener("pageerror", failed)
    return found


def main() -> int:
    """Look at all pages; return 1 if there is anything to report."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("site", type=Path, help="what `mkdocs build -d SITE` wrote")
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each page")
    parser.add_argument("--only", default="", help="pages whose address holds this")
    arguments = parser.parse_args()
    here = serve(arguments.site)
    chosen = [name for name in pages(arguments.site) if arguments.only in name]
    if not chosen:
        parser.error(f"{arguments.site} has no such page")
    wrong = 0
    with sync_playwright() as player:
        browser = player.chromium.launch(executable_path=shutil.which("chromium"))
        for size, width in WIDTHS.items():
            for scheme in SCHEMES:
                page = browser.new_page(
                    viewport={"width": width, "height": 900}, color_scheme=scheme
                )
                for name in chosen:
                    for line in look(page, here + name, size == "wide", here):
                        wrong += 1
                        print(f"{name} ({size}, {scheme}): {line}")
                    if arguments.pictures:
                        picture = f"{name.replace('/', '_')}.{size}.{scheme}.png"
                        page.screenshot(path=arguments.pictures / picture, full_page=True)
                page.close()
        browser.close()
    print(f"{len(chosen)} pages, {len(WIDTHS)} widths, {len(SCHEMES)} schemes: {wrong} to mend")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
