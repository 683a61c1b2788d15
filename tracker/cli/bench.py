"""`tonguetrack bench`: measures this machine, against scipy and against the clock."""

from __future__ import annotations

import argparse
import json
import os


def add_commands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `bench`."""
    bench = subparsers.add_parser(
        "bench",
        help="measure solvers, latency and start-up on this machine",
        description="Measures the solvers against scipy's L-BFGS-B, batch throughput, the latency of the live "
        "loop, and start-up with an empty and a filled cache. Takes about half a minute; run it on a quiet machine.",
    )
    bench.add_argument("--model", metavar="FILE", help="a model file (default: the bundled synthetic model)")
    bench.add_argument("--json", action="store_true", help="print the measurements as JSON")
    bench.set_defaults(run=run_bench)


def run_bench(args: argparse.Namespace) -> int:
    """Measure, then print."""
    # numpy reads these when it is first imported. On matrices of 9 x 9 the library's own threads only slow
    # scipy down, and a ratio against a hobbled baseline would be worth nothing.
    for library in ("OPENBLAS", "OMP", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    from contextlib import nullcontext
    from pathlib import Path

    from ...model import load_model
    from ..bench import bench, report
    from ..bundled import bundled_model_path

    with bundled_model_path() if args.model is None else nullcontext(Path(args.model)) as path:
        result = bench(load_model(path), path)
    print(json.dumps(result, indent=2, allow_nan=False) if args.json else report(result))
    return 0
