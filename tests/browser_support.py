"""A browser for tests that look at a page: headless Chromium, driven by its command line alone."""

import json
import re
import shutil
import subprocess
from html import escape, unescape
from pathlib import Path

import pytest

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-dev-shm-usage", "--enable-logging=stderr",
)  # fmt: skip
TIMEOUT_S = 120.0
WIDTHS_PX = (390, 1280)
"""A telephone's and a laptop's."""
_PROBE = """
<body><script>
addEventListener("load", () => {
  const found = {};
  for (const frame of document.querySelectorAll("iframe")) {
    const page = frame.contentDocument, edge = page.documentElement.clientWidth;
    const scrolled = element => element.closest(".wide, pre, .md-typeset__scrollwrap");
    const over = [...page.body.querySelectorAll("*")].filter(
      e => e.getBoundingClientRect().right > edge + 1 && !scrolled(e)).map(e => e.outerHTML.slice(0, 80));
    const broken = [...page.images].filter(i => i.complete && !i.naturalWidth).map(i => i.alt);
    const excess = page.documentElement.scrollWidth - edge, images = page.images.length;
    found[frame.clientWidth] = {excess, over, broken, images};
  }
  document.body.replaceChildren(Object.assign(document.createElement("output"),
    {textContent: JSON.stringify(found)}));
});
</script>
"""


def chromium() -> str:
    """The browser's path; skips the test where there is none."""
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if found is None:
        pytest.skip("no Chromium here: install Debian's package chromium to look at pages")
    return found


def look(page: Path, folder: Path) -> tuple[dict[int, dict], list[str]]:
    """({width: {excess, over, broken, images}}, console messages) of a page at `WIDTHS_PX`.

    Args:
      page: an HTML file.
      folder: for the browser's profile and the page that holds `page` in frames.

    `excess` is how much wider the page is than the window (px), `over` what ends beyond the window's edge and
    does not scroll by itself, `broken` pictures that do not show.
    """
    text = escape(page.read_text(), quote=True)
    frames = (f'<iframe style="border:0;width:{px}px;height:900px" srcdoc="{text}"></iframe>'
              for px in WIDTHS_PX)  # fmt: skip
    probe = folder / "probe.html"
    probe.write_text(f"<!doctype html><meta charset=utf-8>{_PROBE}{''.join(frames)}")
    done = _run(folder, "--dump-dom", probe.as_uri())
    (found,) = re.findall(r"<output>(.*?)</output>", done.stdout, re.DOTALL)
    console = re.findall(r"CONSOLE.*", done.stderr)
    return {int(px): seen for px, seen in json.loads(unescape(found)).items()}, console


def _run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [chromium(), *FLAGS, f"--user-data-dir={folder / 'profile'}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=True)
