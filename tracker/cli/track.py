"""tonguetrack track and tonguetrack mesh: recordings in, poses and meshes out."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import InputError
from .names import (
    BUNDLED,
    add_recording_flags,
    add_speaker_flag,
    keep_apart,
    named_model,
    parsed_coils,
    prepare_folder,
    replayed,
)
from .showing import poses_to_show
from .workers import add_worker_flags

if TYPE_CHECKING:
    from ...drivers.frames import Recording
    from ...model.multilinear import TongueModel
    from ..pose import TrackedPoses
    from ..session import Session
    from ..tracking import TrackingRun

MAX_NAMED = 20
"""At the end of a long run, at most so many recordings that failed are named again."""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    track = commands.add_parser("track", help="track recordings: poses to a file, live over OSC")
    track.add_argument(
        "recordings", nargs="+", metavar="RECORDING", help="files, or folders that are searched"
    )
    track.add_argument(
        "--model", default=BUNDLED, help="the tongue model (default: the bundled synthetic one)"
    )
    track.add_argument("--session", metavar="FILE", help="the speaker's session file (TOML)")
    track.add_argument("--experiment", choices=("1", "2", "both"), default="2",
                       help="1: anatomy and pose free in every frame; 2: anatomy fixed (default)")  # fmt: skip
    track.add_argument("--out", metavar="FILE", help="poses.csv, .json (as the authors' tracker writes) or .npz; "
                       "for several recordings a folder, or a name with {name} in it")  # fmt: skip
    track.add_argument("--out-folder", metavar="DIR", help="track a whole corpus into this folder, several recordings at a "
                       "time; what is there already is not tracked again")  # fmt: skip
    track.add_argument("--again", action="store_true", help="with --out-folder: also what is unchanged")
    add_worker_flags(track)
    track.add_argument("--palate", metavar="FILE", help="put this palate into the session that is saved: a trace in the "
                       "recording's axes, or a recording of a swept probe")  # fmt: skip
    track.add_argument("--save-session", metavar="FILE",
                       help="write the session with everything that was estimated, to be edited and used again")  # fmt: skip
    track.add_argument(
        "--coils", metavar="CHANNEL=ROLE,...", help="which channel is which coil, where names do not tell"
    )
    track.add_argument("--osc", metavar="HOST:PORT", help="also stream the poses over OSC")
    track.add_argument("--view", action="store_true", help="show the poses in a window (extra 'viewer')")
    add_speaker_flag(track)
    track.add_argument("--realtime", action="store_true", help="stream at the recording's own pace")
    track.add_argument("--json", action="store_true", help="the summary as JSON on stdout")
    add_recording_flags(track)
    track.set_defaults(run=run_track)

    mesh = commands.add_parser("mesh", help="meshes of tracked frames")
    mesh.add_argument("poses", metavar="POSES", help="what 'track --out' wrote, or a take.xdf")
    which = mesh.add_mutually_exclusive_group(required=True)
    which.add_argument("--frame", type=int, metavar="N", help="one frame, counted from 0")
    which.add_argument(
        "--every", type=int, metavar="K", help="every K-th frame, numbered: tongue_000000.ply, ..."
    )
    mesh.add_argument("-o", "--output", required=True, metavar="FILE", help="tongue.ply or tongue.obj")
    add_speaker_flag(mesh)
    mesh.add_argument("--model", help="the model, where it is not where the poses say")
    mesh.set_defaults(run=run_mesh)


# track ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """One recording to track, and where its poses go (experiment -> file)."""

    path: Path
    outputs: dict[int, Path]


def run_track(args: argparse.Namespace) -> int:
    experiments = (1, 2) if args.experiment == "both" else (int(args.experiment),)
    if args.out_folder:
        from .corpus import run_corpus

        folder = Path(os.path.abspath(args.out_folder))
        jobs, left_out = plan_jobs(args.recordings, f"{args.out_folder}{os.sep}", experiments, folder)
        return run_corpus(args, jobs, left_out, experiments)
    if args.again or args.jobs is not None or args.scheduler:
        raise InputError(
            "--again, --jobs and --scheduler track a corpus; say where to with --out-folder DIR."
        )
    jobs, left_out = plan_jobs(args.recordings, args.out, experiments)
    if len(jobs) > 1 and (args.osc or args.save_session or args.view):
        flag = "--osc" if args.osc else "--save-session" if args.save_session else "--view"
        raise InputError(f"{flag} takes one recording; {len(jobs)} were found. Track them one by one.")
    if args.realtime and not args.osc:
        raise InputError("--realtime paces a stream; say where to with --osc HOST:PORT.")
    if args.palate and not args.save_session:
        raise InputError(
            "--palate goes into the session that is saved; say where to with --save-session FILE."
        )
    if args.osc:
        from ..streams.osc import resolve

        resolve(args.osc)
    model = named_model(args.model)
    if args.speaker is not None:
        from ..transfer import other_speaker

        if not args.view:
            raise InputError(
                "--speaker says on whose anatomy the window shows the tongue; add --view. For poses that were written, "
                "'view', 'render', 'export' and 'mesh' have it."
            )
        other_speaker(args.speaker, model)
    session = read_session(args)
    print(f"model: {model.name} [{model.fingerprint}]", file=sys.stderr)
    for path, reason in left_out:
        print(f"left out: {path}: {reason}", file=sys.stderr)
    outputs = [output for job in jobs for output in job.outputs.values()]
    if args.save_session:  # which may well replace --session
        outputs.append(Path(args.save_session))
    read = [*(job.path for job in jobs), Path(args.model)]
    keep_apart(outputs, [*read, Path(args.palate)] if args.palate else read)
    for file in outputs:
        prepare_folder(file)

    reports: list[dict[str, Any]] = []
    failures = 0
    for job in _with_progress(jobs):
        try:
            report = _track_one(job, args, model, session, experiments)
        except InputError as reason:
            if len(jobs) == 1:
                raise
            failures += 1
            sentence = str(reason) if str(job.path) in str(reason) else f"{job.path}: {reason}"
            print(f"tonguetrack: {sentence}", file=sys.stderr)
            reports.append({"recording": str(job.path), "error": sentence})
        else:
            reports.append(report)
    if args.json:
        print(
            json.dumps({"model": model.name, "model_fingerprint": model.fingerprint, "recordings": reports})
        )
    if failures:
        names = [Path(report["recording"]).name for report in reports if "error" in report]
        named = ", ".join(names[:MAX_NAMED]) + (", ..." if failures > MAX_NAMED else "")
        print(
            f"tonguetrack: {failures} of {len(jobs)} recordings could not be tracked: {named}",
            file=sys.stderr,
        )
        return 2
    return 0


def _track_one(
    job: Job, args: argparse.Namespace, model: TongueModel, session: Session, experiments: tuple[int, ...]
) -> dict[str, Any]:
    from ...atomic import write_atomically
    from ...drivers import open_recording
    from ..posefiles import write_poses
    from ..session import session_toml
    from ..tracking import track_recording

    recording = open_recording(job.path, rate_hz=args.rate, unit=args.unit, layout=args.layout)
    run = track_recording(recording, model, session, experiments)
    if args.palate:
        from ..calibration import palate_of_session

        with_palate, told = palate_of_session(Path(args.palate), recording, run)
        setup = replace(run.setup, session=with_palate, decisions=(*run.setup.decisions, *told))
        run = replace(run, setup=setup)
    report = summarise(run, recording, model)
    _print_report(report)
    model_path = BUNDLED if args.model == BUNDLED else str(Path(args.model).resolve())
    for poses in (run.experiment_1, run.experiment_2):
        if poses is not None and poses.experiment in job.outputs:
            write_poses(replace(poses, model_path=model_path), model, job.outputs[poses.experiment])
            print(f"  written: {job.outputs[poses.experiment]}", file=sys.stderr)
    if args.save_session:
        write_atomically(args.save_session, session_toml(run.setup.session).encode())
        print(f"  written: {args.save_session}", file=sys.stderr)
    if args.osc:
        from ..live import stream_recording
        from .watching import watched

        setup = run.setup
        if args.experiment == "1":
            setup = replace(setup, session=replace(setup.session, speaker_weights=None))
        stream = stream_recording(recording, model, setup, args.osc, realtime=args.realtime, watch=watched)
        print(stream, file=sys.stderr)
        report["stream"] = stream.as_dict()
    if args.view:
        _show(run, model, job.path.stem, args.speaker)
    if not job.outputs and not args.osc and not args.view:
        print("  nothing was written; add --out poses.csv, --osc HOST:PORT or --view", file=sys.stderr)
    return report


def _show(run: TrackingRun, model: TongueModel, name: str, speaker: str | None) -> None:
    """The poses in a window. One that cannot be opened is a sentence: the tracking is done."""
    from ..transfer import session_of
    from ..viewer.player import play
    from ..viewer.scene import moments_of
    from .showing import scene_to_show, with_coils

    poses, session = run.experiment_2 or run.experiment_1, run.setup.session
    assert poses is not None
    poses, other = replayed(poses, model, speaker)
    if other is not None:
        session = session_of(other)
        poses = with_coils(poses, session)
    try:
        play(scene_to_show(poses, model, session, name), moments_of(poses))
    except InputError as reason:
        print(f"  no window: {reason}", file=sys.stderr)


def plan_jobs(
    places: Sequence[str], out: str | None, experiments: tuple[int, ...], passed_over: Path | None = None
) -> tuple[list[Job], list[tuple[Path, str]]]:
    """Finds the recordings and gives each its output files; also what was left out, with the reason.

    passed_over: an absolute folder; where it lies below a place, nothing is looked for in it.
    Raises InputError where there is nothing to track or two outputs would have one name.
    """
    from ...drivers import find_recordings

    found: list[Path] = []
    below: dict[Path, Path] = {}  # the folders between what was named and the recording
    left_out: list[tuple[Path, str]] = []
    for place in places:
        if not Path(place).is_dir():
            found.append(Path(place))
            continue
        items = find_recordings(place)
        if passed_over is not None and Path(os.path.abspath(place)) in passed_over.parents:
            items = [item for item in items if passed_over not in Path(os.path.abspath(item.path)).parents]
        recordings = [item.path for item in items if item.is_recording]
        if not recordings:
            raise InputError(
                f"{place}: no recording in this folder; 'tonguetrack info {place}' says what there is."
            )
        found.extend(recordings)
        below.update((path, path.parent.relative_to(place)) for path in recordings)
        left_out.extend((item.path, item.left_out) for item in items if not item.is_recording)
    if out is None:
        return [Job(path, {}) for path in found], left_out
    pattern, is_folder = _output_pattern(out, len(found))
    names = {path: below.get(path, Path()) / path.stem if is_folder else Path(path.stem) for path in found}
    if is_folder:  # two of one name side by side, such as 0021.pos and 0021.txt
        several = Counter(names.values())
        names = {
            path: name.with_name(path.name) if several[name] > 1 else name for path, name in names.items()
        }
    jobs = []
    taken: dict[Path, Path] = {}
    for path in found:
        outputs = {}
        for experiment in experiments:
            file = Path(pattern.replace("{name}", str(names[path])))
            if len(experiments) > 1:
                file = file.with_name(f"{file.stem}.experiment{experiment}{file.suffix}")
            if file in taken:
                raise InputError(
                    f"{path} and {taken[file]} would both be written to {file}; track them one by one, or the "
                    "folder above them into a folder."
                )
            taken[file] = path
            outputs[experiment] = file
        jobs.append(Job(path, outputs))
    return jobs, left_out


def _output_pattern(out: str, recordings: int) -> tuple[str, bool]:
    """The outputs' name with {name} where the recording's comes, and whether `out` was a folder."""
    from ..posefiles import check_pose_suffix

    named_a_folder = out.endswith(("/", os.sep)) or (recordings > 1 and not Path(out).suffix)
    if named_a_folder or Path(out).is_dir():
        return str(Path(out) / "{name}.csv"), True
    check_pose_suffix(out)
    if recordings > 1 and "{name}" not in out:
        raise InputError(
            f"--out {out}: {recordings} recordings were found; give a folder, or a name with {{name}} in it "
            "such as 'poses/{name}.csv'."
        )
    return out, False


def read_session(args: argparse.Namespace) -> Session:
    """The session file, with what --coils says on top."""
    from ..session import Session, load_session

    session = load_session(args.session) if args.session else Session()
    if not args.coils:
        return session
    coils = parsed_coils(args.coils)
    return replace(session, coils=coils, source=session.source if args.session else "--coils")


def summarise(run: TrackingRun, recording: Recording, model: TongueModel) -> dict[str, Any]:
    """What a person judges a tracked recording by, as plain values."""
    report: dict[str, Any] = {
        "recording": recording.source,
        "format": recording.format,
        "frames": recording.frame_count,
        "rate_hz": recording.rate_hz,
        "decisions": [*recording.notes, *run.setup.decisions],
    }
    for poses in (run.experiment_1, run.experiment_2):
        if poses is not None:
            report[f"experiment_{poses.experiment}"] = _figures(poses, run.setup.session.energy.box, model)
    return report


def _figures(poses: TrackedPoses, box: float, model: TongueModel) -> dict[str, Any]:
    import numpy as np

    tracked = poses.tracked
    residual = poses.residual_mm[tracked]
    weights = poses.normalised[tracked]
    if poses.experiment == 1:
        weights = np.column_stack([model.speaker.normalised(poses.speaker_weights[tracked]), weights])
    by_coil = {
        role: float(np.nanmean(poses.residuals_mm[:, index]))
        for index, role in enumerate(poses.roles)
        if np.isfinite(poses.residuals_mm[:, index]).any()
    }
    return {
        "frames_tracked": int(tracked.sum()),
        "frames_held": int((poses.statuses == 2).sum()),
        "residual_mean_mm": float(residual.mean()),
        "residual_median_mm": float(np.median(residual)),
        "share_below_1_25_mm": float((residual < 1.25).mean()),
        "share_below_1_5_mm": float((residual < 1.5).mean()),
        "residual_by_coil_mm": by_coil,
        "largest_weight_sigma": float(np.abs(weights).max()),
        "share_of_frames_at_the_box": float((np.abs(weights) > box - 1e-9).any(axis=1).mean()),
    }


def _print_report(report: dict[str, Any]) -> None:
    from ..status import MISPLACED_MM

    out = sys.stderr
    print(
        f"{report['recording']}: {report['format']}, {report['frames']} frames, {report['rate_hz']:g} Hz",
        file=out,
    )
    for decision in report["decisions"]:
        print(f"  {decision}", file=out)
    for experiment in ("experiment_1", "experiment_2"):
        if experiment not in report:
            continue
        figures = report[experiment]
        coils = ", ".join(f"{role} {value:.2f}" for role, value in figures["residual_by_coil_mm"].items())
        held = f", {figures['frames_held']} held" if figures["frames_held"] else ""
        print(
            f"  {experiment.replace('_', ' ')}: {figures['frames_tracked']} frames tracked{held}; residual mean "
            f"{figures['residual_mean_mm']:.2f} mm ({coils}), {100 * figures['share_below_1_25_mm']:.0f} % below "
            f"1.25 mm, {100 * figures['share_below_1_5_mm']:.0f} % below 1.5 mm; largest weight "
            f"{figures['largest_weight_sigma']:.1f} sigma, {100 * figures['share_of_frames_at_the_box']:.0f} % of "
            "frames at the box",
            file=out,
        )
        if figures["residual_mean_mm"] > MISPLACED_MM:
            print(
                "  warning: residuals of this size mean that the recording is not in the model's frame; "
                "'tonguetrack calibrate' finds its place (see [alignment] in docs/session.md)",
                file=out,
            )


def _with_progress(jobs: list[Job]) -> Any:
    """The jobs one after the other, with a progress bar where there are several and a person to see it."""
    if len(jobs) == 1 or not sys.stderr.isatty():
        return jobs
    from rich.console import Console
    from rich.progress import track as progress

    return progress(jobs, description="tracking", console=Console(stderr=True))


# mesh -----------------------------------------------------------------------------------------------


def run_mesh(args: argparse.Namespace) -> int:
    from ...atomic import write_atomically
    from ...model.mesh import MESH_SUFFIXES, mesh_bytes
    from ..exporting import frame_mesh, write_mesh_sequence

    target = Path(args.output)
    if target.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(
            f"{target}: meshes are written as {' or '.join(MESH_SUFFIXES)}; end the name in one of them."
        )
    poses, model, _ = poses_to_show(args.poses, args.model)
    poses, _ = replayed(poses, model, args.speaker)
    if args.frame is not None:
        if not 0 <= args.frame < poses.frame_count:
            raise InputError(
                f"--frame {args.frame}: {args.poses} has the frames 0 to {poses.frame_count - 1}."
            )
        prepare_folder(target)
        write_atomically(target, mesh_bytes(frame_mesh(model, poses, args.frame), target.suffix))
        written = str(target)
    else:
        if args.every < 1:
            raise InputError(f"--every {args.every}: expected 1 or more.")
        frames = range(0, poses.frame_count, args.every)
        prepare_folder(target)
        write_mesh_sequence(model, poses, frames, target)
        written = f"{len(frames)} meshes beside {target}"
    print(f"written: {written} ({model.name}, {model.vertex_count} vertices, mm)", file=sys.stderr)
    return 0
