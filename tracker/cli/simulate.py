"""tonguetrack simulate ...: recordings of a synthetic speaker, with their truth."""

from __future__ import annotations

import argparse
import sys


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    family = commands.add_parser("simulate", help="make recordings of a synthetic speaker, with their truth")
    kinds = family.add_subparsers(dest="kind", metavar="KIND", required=True)
    recording = kinds.add_parser("recording", help="an EMA recording and, beside it, NAME.truth.npz")
    recording.add_argument("output", metavar="OUT", help="the recording (.csv, .json or .npz)")
    recording.add_argument("--phones", default="ə i ə ɑ ə u ə s a ʃ i ɔ ə", metavar="'P P ...'",
                           help="the phone sequence, with spaces between (default: %(default)s)")  # fmt: skip
    recording.add_argument("--speaker", type=int, default=1, metavar="SEED",
                           help="which speaker outside the training set (default 1)")  # fmt: skip
    recording.add_argument("--seconds", type=float, help="repeat the sequence for that long (default: once)")
    recording.add_argument(
        "--phone-seconds", type=float, default=0.2, metavar="S", help="time a phone (default 0.2)"
    )
    recording.add_argument(
        "--rate", type=float, default=250.0, metavar="HZ", help="frames a second (default 250)"
    )
    recording.add_argument("--coils", default="tongue_tip,tongue_blade,tongue_dorsum", metavar="ROLE,...",
                           help="where coils sit (default: %(default)s); head_nose, head_left, head_right are references")  # fmt: skip
    recording.add_argument(
        "--noise", type=float, default=0.3, metavar="MM", help="standard deviation (default 0.3)"
    )
    recording.add_argument("--dropouts", type=float, default=0.0, metavar="SHARE",
                           help="share of each coil's samples that are missing, in short runs (default 0)")  # fmt: skip
    recording.add_argument("--head-motion", action="store_true", help="move the head; all coils move with it")
    recording.add_argument("--seed", type=int, default=1, help="of noise, dropouts, habits (default 1)")
    recording.set_defaults(run=run_recording)


def run_recording(args: argparse.Namespace) -> int:
    from ..simulation import Simulation, write_simulation

    simulation = Simulation(
        phones=tuple(args.phones.split()),
        coils=tuple(role for role in args.coils.replace(" ", "").split(",") if role),
        speaker=args.speaker,
        seconds=args.seconds,
        phone_s=args.phone_seconds,
        rate_hz=args.rate,
        noise_mm=args.noise,
        dropouts=args.dropouts,
        head_motion=args.head_motion,
        seed=args.seed,
    )
    recording, truth = write_simulation(simulation, args.output)
    print(f"written: {recording} and {truth} (synthetic speaker {args.speaker})", file=sys.stderr)
    return 0
