"""How many pictures a second are drawn offscreen, and what that costs a tracker beside it.

    python tests/bench/rendering.py [--size 800x600] [--seconds 10] [--samples 0]

Three parts, each of --seconds: a tracker alone (`tonguetrack demo`, its own process, 250 Hz); pictures alone; both at
once. Every picture is of another pose of the bundled take, with both views, coils, trails, bars and text, and is read
back. A software rasteriser uses every core it finds: measure on a machine that does nothing else.
"""

import argparse
import json
import subprocess
import sys
import time

import numpy as np

from tonguetrack.tracker.bundled import bundled_model, bundled_recording
from tonguetrack.tracker.setup import complete_setup
from tonguetrack.tracker.tracking import track_recording
from tonguetrack.tracker.viewer.camera import home_view
from tonguetrack.tracker.viewer.look import DARK
from tonguetrack.tracker.viewer.offscreen import Offscreen
from tonguetrack.tracker.viewer.scene import Moments, Scene, moments_of, scene_of

TONGUETRACK = [sys.executable, "-c", "import sys; from tonguetrack.tracker.cli import main; sys.exit(main())"]
NOBODY = "127.0.0.1:9"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--size", default="800x600")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--samples", type=int, default=0)
    args = parser.parse_args()
    width, height = (int(part) for part in args.size.split("x"))

    model = bundled_model()
    recording, session = bundled_recording()
    setup = complete_setup(recording, model, session)
    run = track_recording(recording, model, experiments=(2,), setup=setup)
    assert run.experiment_2 is not None
    moments = moments_of(run.experiment_2)
    scene = scene_of(model, setup.session, setup.roles, setup.vertices, "a bench of synthetic data")
    print(f"tracker alone       {tracker_text(tracker(args.seconds))}", flush=True)
    with Offscreen(scene, (width, height), DARK, args.samples) as offscreen:
        print(f"                    {args.size}, {args.samples} samples, {offscreen.rasteriser}")
        pictures(offscreen, scene, moments, 2.0)
        print(f"pictures alone      {pictures(offscreen, scene, moments, args.seconds)}", flush=True)
        beside = tracker(args.seconds + 4.0)
        time.sleep(3.0)  # until it has loaded everything and tracks
        print(f"pictures beside it  {pictures(offscreen, scene, moments, args.seconds)}", flush=True)
        print(f"tracker beside them {tracker_text(beside)}")


def tracker(seconds: float) -> subprocess.Popen[str]:
    command = [*TONGUETRACK, "demo", "--seconds", f"{seconds:g}", "--osc", NOBODY, "--json"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def tracker_text(process: subprocess.Popen[str]) -> str:
    summary = json.loads(process.communicate()[0])
    parts = []
    for name, words in (
        ("arrival_to_sent_ms", "arrival to sent"),
        ("lateness_ms", "frames handed over late by"),
    ):
        numbers = summary[name]
        parts.append(f"{words} p50 {numbers['p50']:.2f} p99 {numbers['p99']:.2f} max {numbers['max']:.1f} ms")
    return "; ".join(parts)


def pictures(offscreen: Offscreen, scene: Scene, moments: Moments, seconds: float) -> str:
    """Draws one picture of the take after the other for so long."""
    view = home_view(scene)
    took: list[float] = []
    start = time.perf_counter()
    frame = 0
    while (before := time.perf_counter()) < start + seconds:
        offscreen.picture(moments[frame % len(moments)], view)
        took.append(1e3 * (time.perf_counter() - before))
        frame += 4
    p50, p99 = np.percentile(took, [50, 99])
    return f"{1e3 * len(took) / sum(took):.0f} a second; each p50 {p50:.2f} p99 {p99:.2f} ms"


if __name__ == "__main__":
    main()
