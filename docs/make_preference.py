"""Draws docs/preference.webp: the page of a preference test in a browser.

    python docs/make_preference.py TEST

TEST is a folder that `tonguetrack mri preference make` made; it is left without answers. Needs Chromium, and the extras
`mri` and `dev`.
"""

import sys
import tempfile
import threading
from pathlib import Path

from PIL import Image

from tonguetrack.model.mri.preference import load_test
from tonguetrack.tracker.preferenceserver import PreferenceServer

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parent / "tests"))

from browser import Browser
from displays import require_chromium

TARGET = HERE / "preference.webp"
SIZE = (1200, 520)
SHOWN = 3


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        test = Path(folder) / "test"
        test.mkdir()
        for name in ("test.json", "pictures"):
            (test / name).symlink_to(Path(sys.argv[1]).resolve() / name)
        with PreferenceServer(load_test(test), "127.0.0.1:0", participant="Anna") as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            for place in range(SHOWN - 1):
                server.begin("Anna")
                server.choose("Anna", place, "right")
            with Browser(require_chromium()) as browser, browser.open(server.url, *SIZE) as tab:
                tab.wait(
                    f"document.querySelector('#count')?.innerText.includes('slice {SHOWN} of')"
                    " && !document.querySelector('.waiting')"
                )
                picture = tab.picture()
            server.shutdown()
    Image.fromarray(picture).save(TARGET, quality=88)
    print(f"{TARGET}: {TARGET.stat().st_size} bytes")


if __name__ == "__main__":
    main()
