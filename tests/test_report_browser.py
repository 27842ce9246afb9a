"""The report in a real browser: nothing in the console, nothing asked for outside, every picture
drawn.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.study.tiny import write_tiny
from torchsar.cli import main

BROWSER = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)
PROBE = """<script>addEventListener("load", () => {
  const images = [...document.images], broken = images.filter(i => !i.complete || i.naturalWidth < 100).length;
  const outside = performance.getEntriesByType("resource").map(e => e.name).filter(n => !n.startsWith("data:"));
  const wide = document.documentElement.scrollWidth > innerWidth;
  document.body.dataset.probe = JSON.stringify({images: images.length, broken, outside, title: document.title, wide});
});</script>"""


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


def test_every_picture_is_drawn_and_nothing_comes_from_outside(report: Path, tmp_path: Path) -> None:
    probed = tmp_path / "probed.html"
    probed.write_text(report.read_text().replace("</body>", PROBE + "</body>"))
    dom = browse(probed, tmp_path / "profile", "--window-size=1200,900", "--dump-dom").stdout
    found = re.search(r'data-probe="([^"]*)"', dom)
    assert found, dom[:500]
    probe = found.group(1).replace("&quot;", '"')
    assert '"broken":0' in probe and '"outside":[]' in probe and '"wide":false' in probe
    assert int(re.search(r'"images":(\d+)', probe).group(1)) == len(list((report.parent / "figures").iterdir()))  # type: ignore[union-attr]
