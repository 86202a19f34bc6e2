"""The report in headless Chromium: it draws every figure, says nothing on the console, and fits a telephone."""

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.browser

LOOK = """
<script>
addEventListener("load", () => {
  const images = [...document.images].map(i => [i.alt, i.complete && i.naturalWidth, i.getBoundingClientRect().width]);
  const root = document.documentElement;
  const text = Math.min(...[...document.querySelectorAll("p, td, figcaption")].map(e =>
    parseFloat(getComputedStyle(e).fontSize)));
  const scrolled = [...document.querySelectorAll(".scroll")].filter(e => e.scrollWidth > e.clientWidth);
  const names = scrolled.map(box => {
    box.scrollLeft = box.scrollWidth;
    const cell = box.querySelector("tbody th").getBoundingClientRect(), frame = box.getBoundingClientRect();
    return [box.ariaLabel, cell.left - frame.left, cell.width / frame.width];
  });
  const said = {width: innerWidth, overflow: root.scrollWidth - root.clientWidth, images, text, names};
  parent.postMessage(JSON.stringify(said), "*");
});
</script>
"""
"""measures the page it stands in, and tells the page around it"""

AROUND = """<!doctype html><body style="margin:0"><iframe src="{page}" style="border:0;width:{width}px;height:900px">
</iframe><script>addEventListener("message", e => document.body.dataset.said = e.data);</script></body>"""
"""a window of any width: Chromium's own does not become as narrow as a telephone"""


def chromium() -> str:
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if found := shutil.which(name):
            return found
    raise AssertionError("no Chromium here; Debian: apt-get install chromium")


def opened(report: Path, width: int, directory: Path) -> tuple[dict[str, Any], str]:
    """What the page says of itself in a window so wide, and what stands on the console."""
    page = (report / "report.html").read_text()
    (directory / "page.html").write_text(page.replace("</body>", LOOK + "</body>"))
    (directory / "around.html").write_text(AROUND.format(page="page.html", width=width))
    command = [
        *(chromium(), "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"),
        *(f"--user-data-dir={directory / 'profile'}", f"--window-size={width + 100},1000", "--timeout=60000"),
        *("--dump-dom", (directory / "around.html").as_uri()),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=True)
    said = re.search(r'data-said="([^"]+)"', done.stdout)
    assert said, f"the page said nothing: {done.stdout[:500]} {done.stderr[-2000:]}"
    return json.loads(unescape(said[1])), "\n".join(re.findall(r".*CONSOLE.*", done.stderr))


@pytest.mark.parametrize("width", [400, 1400])
def test_the_page_is_whole_and_readable(report_of_all, width, tmp_path):
    said, console = opened(report_of_all, width, tmp_path)
    assert said["width"] == width
    assert console == ""
    assert said["overflow"] <= 0
    assert said["text"] >= 11  # CSS pixels
    for caption, left, share in said["names"]:  # of the rows of a table that is too wide, scrolled to its end
        assert 0 <= left < 2, caption
        assert share < 0.5, caption
    assert said["names"] or width > 400
    assert len(said["images"]) == len(list((report_of_all / "figures").glob("*.svg")))
    for caption, own_width, shown_width in said["images"]:
        assert own_width > 0, caption
        # a figure is drawn for 4.2 inches, 403 CSS pixels: its letters of 9 points stay larger than 8 CSS pixels
        assert shown_width >= 300, caption
