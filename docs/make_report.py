"""Draws docs/mri-report.webp: the beginning of a report of `mri build`, as Chromium shows it.

    python docs/make_report.py REPORT

where REPORT is what `mri build --report REPORT` wrote for a phantom's data set. Needs Chromium and the extra `mri`. Look at
the picture whenever the page changes.
"""

import io
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

TARGET = Path(__file__).parent / "mri-report.webp"
WIDTH, HEIGHT = 1200, 2600
SHOWN = 0.75  # of the size


def main(report: Path) -> None:
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        sys.exit("needs Chromium")
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "page.png"
        flags = ["--headless", "--no-sandbox", f"--window-size={WIDTH},{HEIGHT}", "--hide-scrollbars"]
        page = (report / "index.html").resolve().as_uri()
        subprocess.run([program, *flags, f"--screenshot={picture}", page], check=True)
        shot = Image.open(io.BytesIO(picture.read_bytes())).convert("RGB")
    small = shot.resize((round(WIDTH * SHOWN), round(HEIGHT * SHOWN)), Image.Resampling.LANCZOS)
    small.save(TARGET, quality=84, method=6)
    print(f"{TARGET}: {TARGET.stat().st_size} bytes")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
