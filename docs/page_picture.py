"""Makes docs/images/hand_page.png: experiment C as a page, in Chromium, while the pointer pulls.

Run from the checkout: ``.venv/bin/python docs/page_picture.py``. It needs the extra ``test`` and Chromium.
"""

import shutil
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

from loopwright import experiments

SIZE = {"width": 1100, "height": 760}
PULL = [(0.6, 0.30, 900), (0.55, 0.18, 900), (0.45, 0.12, 1500), (0.33, 0.14, 90)]
"""Where the pointer goes, as parts of the picture's width and height, and the ticks that it stays there."""


def main(picture: Path) -> None:
    """Write the picture."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        file = Path(folder, "hand.html")
        experiments.hand_page(file)
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport=SIZE)
        page.goto(file.as_uri())
        box = page.locator(".scene canvas").bounding_box()
        assert box is not None
        x, y, width, height = (box[name] for name in ("x", "y", "width", "height"))
        page.mouse.move(x + PULL[0][0] * width, y + PULL[0][1] * height)
        page.mouse.down()
        for across, down, stay in PULL:
            page.mouse.move(x + across * width, y + down * height)
            page.evaluate(f"page.pause(); page.advance({stay})")
        page.wait_for_timeout(200)
        page.evaluate("document.getElementById('note').hidden = true")
        page.screenshot(path=picture)
        browser.close()


if __name__ == "__main__":
    main(Path(__file__).parent / "images" / "hand_page.png")
