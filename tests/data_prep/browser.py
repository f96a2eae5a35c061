"""A page in a real browser: what it complains of, which pictures decode, whether it fits."""

import json
import re
import shutil
import subprocess

import pytest

_PROBE = """<script>
// Drawings' images tell nothing about themselves; copies that the page waits for do.
for (const drawn of [...document.querySelectorAll('image')]) {
  const copy = document.createElement('img');
  copy.src = drawn.getAttribute('href');
  copy.style.display = 'none';
  document.body.append(copy);
}
addEventListener('load', () => {
  const images = [...document.images];
  const out = [...document.querySelectorAll('main > *, article, figure')].filter(
    e => e.getBoundingClientRect().right > innerWidth + 1);
  document.title = JSON.stringify({
    images: images.length,
    decoded: images.filter(i => i.complete && i.naturalWidth > 0).length,
    first: [images[0].naturalWidth, images[0].naturalHeight],
    sticking_out: out.length,
    wide: document.documentElement.scrollWidth > innerWidth,
  });
});
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
