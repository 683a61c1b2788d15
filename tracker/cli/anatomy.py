"""`tonguetrack anatomy`: who the speaker is, in three ways side by side."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import InputError
from .names import BUNDLED, add_recording_flags, keep_apart, named_model, prepare_folder
from .track import read_session

if TYPE_CHECKING:
    from ...model.multilinear import TongueModel
    from ..session import Session
    from ..speakers import Comparison, SpeakerResult

WAYS = ("mean", "joint", "mesh")


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `anatomy`."""
    anatomy = commands.add_parser(
        "anatomy",
        help="estimate the speaker's anatomy in three ways and compare them",
        description="The speaker's weights as the paper has them (mean: the average of the frames of experiment 1), as "
        "one speaker for all frames (joint), and from surfaces of this speaker (mesh), with how sure each is, how well "
        "the recording is tracked with it, and where they differ. An MRI volume cannot be fitted yet; a surface mesh "
        "made from it can.",
    )
    anatomy.add_argument("recording", metavar="RECORDING", help="a recording of the speaker")
    anatomy.add_argument("--model", default=BUNDLED, help="the tongue model (default: the bundled synthetic one)")  # fmt: skip
    anatomy.add_argument("--session", metavar="FILE", help="the speaker's session file (TOML)")
    anatomy.add_argument("--coils", metavar="CHANNEL=ROLE,...",
                         help="which channel is which coil, where names do not tell")  # fmt: skip
    anatomy.add_argument(
        "--mesh", action="extend", nargs="+", default=[], metavar="FILE",
        help="surfaces of the speaker's tongue (.ply, .obj), in mm and in the model's frame; with the model's own "
        "vertices and faces they are fitted vertex by vertex, else by nearest points; no MRI volumes",
    )  # fmt: skip
    anatomy.add_argument("--seconds", type=float, metavar="N",
                         help="estimate from the first N seconds of speech only (tracked is all of it)")  # fmt: skip
    anatomy.add_argument("--save-session", metavar="FILE",
                         help="write the session with the speaker that --use names")  # fmt: skip
    anatomy.add_argument("--use", choices=WAYS, help="which way's speaker goes into --save-session")
    anatomy.add_argument("--json", action="store_true", help="everything as JSON on stdout")
    add_recording_flags(anatomy)
    anatomy.set_defaults(run=run_anatomy)


def run_anatomy(args: argparse.Namespace) -> int:
    _check_flags(args)
    from ...drivers import open_recording
    from ...model.mesh import read_mesh
    from ..setup import complete_setup
    from ..speakers import compare_speakers

    model = named_model(args.model)
    session = read_session(args)
    if args.save_session:  # which may well replace --session
        output = Path(args.save_session)
        keep_apart([output], map(Path, [args.recording, args.model, *args.mesh]))
        prepare_folder(output)
    recording = open_recording(args.recording, rate_hz=args.rate, unit=args.unit, layout=args.layout)
    meshes = [read_mesh(path) for path in args.mesh]
    # Only its speaker is estimated anew; coils, alignment, and vertices stay those of the session.
    setup = complete_setup(recording, model, replace(session, speaker_weights=None, speaker_source=""))
    print(f"model: {model.name} [{model.fingerprint}]", file=sys.stderr)
    for decision in setup.decisions:
        print(f"  {decision}", file=sys.stderr)
    comparison = compare_speakers(recording, model, setup, meshes, args.seconds)
    report = summarise(comparison, model)
    if warning := misplaced(report):
        print(f"  {warning}", file=sys.stderr)
    if args.json:
        print(json.dumps({"recording": recording.source, "model_fingerprint": model.fingerprint, **report}))
    else:
        print("\n".join(described(report)))
    if args.save_session:
        _save(args.save_session, setup.session, comparison.results[args.use])
    else:
        print("  to keep one of them: --save-session FILE --use WAY", file=sys.stderr)
    return 0


def _check_flags(args: argparse.Namespace) -> None:
    if bool(args.save_session) != bool(args.use):
        raise InputError(
            "--save-session FILE and --use mean|joint|mesh belong together; give both or neither."
        )
    if args.use == "mesh" and not args.mesh:
        raise InputError("--use mesh: there is no mesh; name one or more of this speaker with --mesh FILE.")


def _save(path: str, session: Session, result: SpeakerResult) -> None:
    from ...atomic import write_atomically
    from ..session import session_toml

    saved = replace(session, speaker_weights=result.weights, speaker_source=result.sentence)
    write_atomically(path, session_toml(saved).encode())
    print(f"  written: {path}", file=sys.stderr)


def summarise(comparison: Comparison, model: TongueModel) -> dict[str, Any]:
    """The comparison as plain values; an uncertainty that nothing can be said of is None."""
    from ..speakers import GOOD_MM

    def finite(values: Any) -> list[float | None]:
        return [float(value) if value < float("inf") else None for value in values]

    return {
        "ways": {
            way: {
                "weights": result.weights.tolist(),
                "normalised": model.speaker.normalised(result.weights).tolist(),
                "sigma": finite(result.sigma),
                "samples": result.samples,
                "residual_mm": result.residual_mm,
                "source": result.sentence,
                "tracked_residual_mm": comparison.tracked[way].residual_mm,
                "tracked_share_good": comparison.tracked[way].good,
            }
            for way, result in comparison.results.items()
        },
        "good_mm": GOOD_MM,
        "mean_tongue_distances_mm": [
            {"one": one, "other": other, "distance_mm": distance}
            for (one, other), distance in comparison.distances_mm.items()
        ],
        "differences": [
            {
                "one": found.one,
                "other": found.other,
                "weight": found.weight,
                "difference_sigma": found.difference,
                "standard_error_sigma": found.error,
            }
            for found in comparison.differences
        ],
    }


def misplaced(report: dict[str, Any]) -> str | None:
    """A warning where even the best of the speakers leaves the coils far from the model."""
    from ..status import MISPLACED_MM

    best = min(found["tracked_residual_mm"] for found in report["ways"].values())
    if best <= MISPLACED_MM:
        return None
    return (
        f"warning: the coils stay {best:.1f} mm away with the best of these speakers: the recording is not in the "
        "model's frame, and the weights mean nothing; 'tonguetrack calibrate' finds its place (see [alignment] in "
        "docs/session.md)"
    )


def described(report: dict[str, Any]) -> list[str]:
    """The lines that people read."""
    ways = report["ways"]
    count = len(next(iter(ways.values()))["normalised"])
    header = "".join(f"{f's{weight}':>16}" for weight in range(1, count + 1))
    lines = ["speaker weights in sigma, +- standard error:", f"{'':6}{header}"]
    for way, found in ways.items():
        cells = (
            f"{value:+.2f} +- {'?' if error is None else f'{error:.2f}'}"
            for value, error in zip(found["normalised"], found["sigma"], strict=True)
        )
        lines.append(f"{way:6}" + "".join(f"{cell:>16}" for cell in cells))
    lines.append("")
    lines += [
        f"{way}: {found['source']}; its own residual {found['residual_mm']:.2f} mm; experiment 2 with it: mean "
        f"{found['tracked_residual_mm']:.2f} mm, {100 * found['tracked_share_good']:.0f} % of the frames below "
        f"{report['good_mm']:g} mm"
        for way, found in ways.items()
    ]
    lines += [
        f"{pair['one']} and {pair['other']}: mean tongues {pair['distance_mm']:.2f} mm apart (whole mesh)"
        + _contradictions(report["differences"], pair["one"], pair["other"])
        for pair in report["mean_tongue_distances_mm"]
    ]
    return lines


def _contradictions(differences: list[dict[str, Any]], one: str, other: str) -> str:
    named = [
        f"s{found['weight']} by {found['difference_sigma']:+.2f} (standard error {found['standard_error_sigma']:.2f})"
        for found in differences
        if (found["one"], found["other"]) == (one, other)
    ]
    return (
        "; beyond their uncertainty differ " + ", ".join(named)
        if named
        else "; no weight beyond its uncertainty"
    )
