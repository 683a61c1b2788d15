"""tonguetrack mri phantom: scans of invented speakers, whose true surfaces are known."""

from __future__ import annotations

import argparse
import sys


def add_verbs(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    phantom = verbs.add_parser(
        "phantom",
        help="make MRI scans of invented speakers, whose true surfaces are known",
        description="Renders MRI volumes of invented vocal tracts that hold the paper's 13 phones, lists them in "
        "OUT/dataset.toml, and writes the true surfaces into OUT/truth.",
    )
    phantom.add_argument("folder", metavar="OUT", help="an absent or empty folder")
    phantom.add_argument("--speakers", type=int, default=11, metavar="N", help="how many (default 11)")
    phantom.add_argument(
        "--seed", type=int, default=0, metavar="S", help="another number, other speakers (default 0)"
    )
    phantom.set_defaults(run=run_phantom)


def run_phantom(args: argparse.Namespace) -> int:
    from functools import partial

    from ...model.mri.phantom.making import make_phantom
    from .progress import with_progress

    bar = partial(with_progress, description="scanning")
    path = make_phantom(args.folder, args.speakers, args.seed, progress=bar)
    print(
        f"{path}: synthetic speakers; build with 'tonguetrack mri build {path} -o model.npz'", file=sys.stderr
    )
    return 0
