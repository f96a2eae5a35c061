"""A page in a real browser: what it complains of, which pictures decode, whether it fits."""

import json
import re
import shutil
import subprocess

import pytest

_PROBE = """<script>
(async () => {
  const sources = [...document.images].map(i => i.src).concat(
    [...document.querySelectorAll('image')].map(i => i.getAttribute('href')));
  let decoded = 0, first = [0, 0];
  for (const source of sources) {
    const image = new Image();
    image.src = source;
    try { await image.decode(); decoded += image.naturalWidth > 0; } catch (error) { continue; }
    if (decoded == 1) first = [image.naturalWidth, image.naturalHeight];
  }
  const left = [...document.querySelectorAll('main > *, article, figure')].filter(
    e => e.getBoundingClientRect().right > innerWidth + 1).length;
  document.title = JSON.stringify({images: sources.length, decoded, first, sticking_out: left,
    wide: document.documentElement.scrollWidth > innerWidth});
})();
</script>"""


def find_browser():
    """Give a browser, or skip."""
    found = next(
        filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
    )
    if not found:
        pytest.skip("no chromium to open the page in")
    return found


def open_page(page, folder, width):
    """Open a page from disk without a network; give what was found on it.

    A copy with a script at its end is opened, since the page has none.
    """
    browser = find_browser()
    probed = folder / f"probed_{width}.html"
    html = page.read_text(encoding="utf-8")
    assert html.rstrip().endswith("</html>")
    probed.write_text(html.replace("</body>", f"{_PROBE}</body>"), encoding="utf-8")
    done = subprocess.run(
        [
            browser,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--host-resolver-rules=MAP * ~NOTFOUND",
            "--enable-logging=stderr",
            f"--user-data-dir={folder / 'profile'}",
            f"--window-size={width},1200",
            "--virtual-time-budget=20000",
            "--dump-dom",
            probed.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    # Drawings have titles as well; the page's own is the first.
    found = json.loads(re.findall(r"<title>(.*?)</title>", done.stdout)[0])
    found["console"] = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return found
