"""tonguetrack mri ...: from MRI scans to a model, at once or step by step."""

from __future__ import annotations

import argparse

from . import mribuild, mrimatch, mripalate, mripreference, phantom, scansteps


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    family = commands.add_parser("mri", help="from MRI scans to a model, at once or step by step")
    verbs = family.add_subparsers(dest="verb", metavar="VERB", required=True)
    mribuild.add_verbs(verbs)
    scansteps.add_verbs(verbs)
    mrimatch.add_verbs(verbs)
    mripalate.add_verbs(verbs)
    phantom.add_verbs(verbs)
    mripreference.add_verbs(verbs)
