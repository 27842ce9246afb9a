"""The report in a real browser: nothing in the console, no external resources, every picture drawn,
and a layout that fits wide and narrow pages.
"""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.study.tiny import write_tiny
from torchsar.cli import main

BROWSER = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)
# in the report: what it loads, elements that reach over its edge outside of boxes that scroll, and
# the largest number of panels of a picture that stand side by side
PROBE = """<script>addEventListener("load", () => {
  const images = [...document.images], broken = images.filter(i => !i.complete || i.naturalWidth < 100).length;
  const outside = performance.getEntriesByType("resource").map(e => e.name).filter(n => !n.startsWith("data:"));
  const free = [...document.body.querySelectorAll("*")].filter(e => !e.parentElement.closest(".scroll, pre"));
  const wide = free.filter(e => e.getBoundingClientRect().right > innerWidth + 0.5).map(e => e.outerHTML.slice(0, 80));
  if (document.documentElement.scrollWidth > innerWidth) wide.push("page");
  const rows = [...document.querySelectorAll(".panels")].flatMap(p => {
    const tops = [...p.children].map(i => i.offsetTop);
    return tops.map(top => tops.filter(other => other === top).length);
  });
  parent.postMessage(JSON.stringify({images: images.length, broken, outside, wide, columns: Math.max(...rows)}), "*");
});</script>"""
# a narrow window is not narrow in every browser, but a frame is
FRAME = """<!doctype html><script>addEventListener("message", e => document.body.dataset.probe = e.data);</script>
<body><iframe width="{width}" height="900" src="{page}"></iframe></body>"""


def browse(page: Path, profile: Path, *options: str) -> subprocess.CompletedProcess[str]:
    assert BROWSER is not None
    common = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--no-first-run",
        "--disable-extensions",
        "--virtual-time-budget=5000",
        f"--user-data-dir={profile}",
    ]
    return subprocess.run(
        [BROWSER, *common, *options, page.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        stdin=subprocess.DEVNULL,
    )


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if BROWSER is None:
        pytest.skip("no chromium on this machine; .ci/run installs it")
    folder = tmp_path_factory.mktemp("browser")
    assert main(["run", str(write_tiny(folder)), "--out", str(folder / "result")]) == 0
    return folder / "result" / "report.html"


def test_console_is_silent(report: Path, tmp_path: Path) -> None:
    done = browse(report, tmp_path / "profile", "--enable-logging=stderr", "--v=0", "--dump-dom")
    assert done.returncode == 0, done.stderr[-1000:]
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert not console, console


def test_console_messages_would_be_seen(report: Path, tmp_path: Path) -> None:
    loud = tmp_path / "loud.html"
    loud.write_text(report.read_text().replace("</main>", "</main><script>console.error('here')</script>"))
    done = browse(loud, tmp_path / "profile", "--enable-logging=stderr", "--v=0", "--dump-dom")
    assert any("CONSOLE" in line and "here" in line for line in done.stderr.splitlines())


def probe(page: str, width: int, folder: Path) -> dict[str, Any]:
    """What a page reports that is shown in a frame of a width in pixels."""
    (folder / "probed.html").write_text(page.replace("</body>", PROBE + "</body>"))
    (folder / "frame.html").write_text(FRAME.format(width=width, page="probed.html"))
    dom = browse(folder / "frame.html", folder / "profile", "--window-size=1300,1000", "--dump-dom").stdout
    found = re.search(r'data-probe="([^"]*)"', dom)
    assert found, dom[:500]
    return json.loads(html.unescape(found.group(1)))


@pytest.mark.parametrize(("width", "columns"), [(1200, 2), (420, 1)])
def test_pictures_are_drawn_and_panels_wrap_on_a_narrow_page(
    report: Path, tmp_path: Path, width: int, columns: int
) -> None:
    found = probe(report.read_text(), width, tmp_path)
    assert found["broken"] == 0 and found["outside"] == []
    # one picture stands at the head of the page as well
    assert found["images"] == len(list((report.parent / "figures").iterdir())) + 1
    assert found["wide"] == []
    assert found["columns"] == columns


def test_a_page_that_is_too_wide_would_be_seen(report: Path, tmp_path: Path) -> None:
    wide = report.read_text().replace("</main>", '<div style="width: 500px">wide</div></main>')
    assert any("500px" in element for element in probe(wide, 420, tmp_path)["wide"])
