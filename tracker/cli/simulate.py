"""tonguetrack simulate ...: recordings of a synthetic speaker with their truth, and devices that are not there."""

from __future__ import annotations

import argparse
import re
import signal
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ... import InputError

if TYPE_CHECKING:
    from ...drivers import Recording

PHONES = "ə i ə ɑ ə u ə s a ʃ i ɔ ə"
COILS = "tongue_tip,tongue_blade,tongue_dorsum"
SYNTHETIC_S = 20.0
MOST_SENSORS = 256
POLARIS_HZ = 60.0


@dataclass(frozen=True)
class SimulatedDevice:
    """port, rate_hz: the usual ones; own_pace: whether it measures at that rate whatever it is given to play;
    options: those that this kind alone has."""

    port: int
    rate_hz: float
    own_pace: bool
    options: tuple[str, ...]


DEVICES = {
    "rtc3d": SimulatedDevice(3030, 400.0, False, ("nul", "missing")),
    "ndi": SimulatedDevice(8765, 40.0, True, ("pty", "rfc2217", "model")),
    "carstens": SimulatedDevice(30303, 250.0, False, ("layout",)),
}


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    family = commands.add_parser(
        "simulate", help="make recordings of a synthetic speaker, or stand in for a device"
    )
    kinds = family.add_subparsers(dest="kind", metavar="KIND", required=True)
    _add_recording(kinds)
    _add_device(kinds)


def _add_recording(kinds: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    recording = kinds.add_parser("recording", help="an EMA recording and, beside it, NAME.truth.npz")
    recording.add_argument("output", metavar="OUT", help="the recording (.csv, .json or .npz)")
    recording.add_argument("--phones", default=PHONES, metavar="'P P ...'",
                           help="the phone sequence, with spaces between (default: %(default)s)")  # fmt: skip
    recording.add_argument("--speaker", type=int, default=1, metavar="N",
                           help="which speaker outside the training set (default 1; from 4 on, and 0, some seconds to compute)")  # fmt: skip
    recording.add_argument("--seconds", type=float, help="repeat the sequence for that long (default: once)")
    recording.add_argument(
        "--phone-seconds", type=float, default=0.2, metavar="S", help="time a phone (default 0.2)"
    )
    recording.add_argument(
        "--rate", type=float, default=250.0, metavar="HZ", help="frames a second (default 250)"
    )
    recording.add_argument("--coils", default=COILS, metavar="ROLE,...",
                           help="where coils sit (default: %(default)s); head_nose, head_left, head_right are references")  # fmt: skip
    recording.add_argument(
        "--noise", type=float, default=0.3, metavar="MM", help="standard deviation (default 0.3)"
    )
    recording.add_argument("--dropouts", type=float, default=0.0, metavar="SHARE",
                           help="share of each coil's samples that are missing, in short runs (default 0)")  # fmt: skip
    recording.add_argument("--head-motion", action="store_true", help="move the head; all coils move with it")
    recording.add_argument("--palate", metavar="FILE", help="also write a trace of this speaker's palate: x, y, z of "
                           "a point a line, mm, in the recording's axes")  # fmt: skip
    recording.add_argument(
        "--seed", type=int, default=1, help="of noise, dropouts and head motion (default 1)"
    )
    recording.set_defaults(run=run_recording)


def _add_device(kinds: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    device = kinds.add_parser(
        "device",
        help="a device that plays a recording, for developing without hardware",
        description="Stands in for a device until Ctrl-C. The source's URI is the one line on standard output.",
    )
    device.add_argument(
        "device", choices=DEVICES, help="rtc3d: NDI Wave; ndi: Aurora, Polaris; carstens: AG50x"
    )
    motion = device.add_mutually_exclusive_group(required=True)
    motion.add_argument(
        "--from", dest="recording", metavar="RECORDING", help="plays this file, over and over"
    )
    motion.add_argument(
        "--synthetic",
        action="store_true",
        help=f"plays a synthetic speaker ({SYNTHETIC_S:g} s, over and over)",
    )
    device.add_argument("--rate", type=float, metavar="HZ",
                        help="frames a second (default: the file's, NDI's own 40 or 60, and with --synthetic the usual ones)")  # fmt: skip
    device.add_argument(
        "--coils", metavar="ROLE,...", help=f"with --synthetic: where coils sit (default: {COILS})"
    )
    device.add_argument("--sensors", type=int, metavar="N",
                        help="sensors in all: fills up with coils that lie still, or leaves out the last ones")  # fmt: skip
    device.add_argument("--seed", type=int, metavar="N", help="with --synthetic: of its noise (default 1)")
    device.add_argument("--host", default="127.0.0.1", metavar="ADDRESS",
                        help="where to listen (default: %(default)s, this computer alone; 0.0.0.0: the network)")  # fmt: skip
    device.add_argument(
        "--port", type=int, metavar="N", help="port to listen on (default: the device's own; 0: any)"
    )
    device.add_argument("--faults", default="", metavar="LIST",
                        help="what goes wrong, as in drop=0.01,stall=1@5,disconnect@8,jump=2@3,dead=tongue_tip@3-5,"
                             "noisy=tongue_tip:2; also duplicate, reorder, corrupt, seed")  # fmt: skip
    device.add_argument("--seconds", type=float, metavar="S", help="ends by itself")
    device.add_argument("--nul", action="store_true", default=None, help="rtc3d: texts end in NUL")
    device.add_argument(
        "--missing", choices=("ff", "zeros"), help="rtc3d: how a missing coil looks (default ff)"
    )
    device.add_argument("--pty", action="store_true", default=None, help="ndi: on a pseudo-terminal")
    device.add_argument("--rfc2217", action="store_true", default=None, help="ndi: as a serial port server")
    device.add_argument("--model", choices=("aurora", "polaris"), help="ndi: which one (default aurora)")
    device.add_argument("--layout", help="carstens: ag500, ag501, ag501-head, ... (default ag501)")
    device.add_argument(
        "--file-rate", type=float, metavar="HZ", help="sampling rate, where the file states none"
    )
    device.add_argument("--file-unit", metavar="UNIT", help="unit of positions, where the file states none")
    device.add_argument("--file-layout", metavar="LAYOUT", help="layout of the file, as --layout of `info`")
    device.set_defaults(run=run_device)


def run_recording(args: argparse.Namespace) -> int:
    from ..simulation import Simulation, palate_trace, truth_path, write_palate, write_simulation
    from .names import prepare_folder

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
    if not simulation.ships:
        print(f"speaker {args.speaker}: computing each phone, which takes some seconds ...", file=sys.stderr)
    if args.palate:
        trace = palate_trace(simulation)
        taken = [Path(args.output).resolve(), truth_path(args.output).resolve()]
        if Path(args.palate).resolve() in taken:
            raise InputError(
                f"--palate {args.palate}: the recording or its truth goes there; choose another name."
            )
        prepare_folder(Path(args.palate))
    recording, truth = write_simulation(simulation, args.output)
    print(f"written: {recording} and {truth} (synthetic speaker {args.speaker})", file=sys.stderr)
    if args.palate:
        write_palate(trace, args.palate)
        print(f"written: {args.palate} ({len(trace)} points of this speaker's palate)", file=sys.stderr)
    return 0


def run_device(args: argparse.Namespace) -> int:
    _check_device(args)
    from ...drivers.simulators.faults import parse_faults
    from ...drivers.simulators.motion import SimulatedMotion

    recording = _synthetic(args) if args.synthetic else _opened(args)
    if args.sensors is not None:
        recording = _with_sensors(recording, args.sensors)
    motion = SimulatedMotion(recording, _pace_hz(args))
    plan = parse_faults(args.faults, motion.coils)
    port = DEVICES[args.device].port if args.port is None else args.port

    def announce(uri: str) -> None:
        print(uri, flush=True)
        print(
            f"simulated {args.device}: {len(motion.coils)} coils ({', '.join(motion.coils)}) at "
            f"{motion.rate_hz:g} Hz; Ctrl-C ends it",
            file=sys.stderr,
            flush=True,
        )

    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        if args.device == "rtc3d":
            from ...drivers.simulators.rtc3d_sim import run_rtc3d

            run_rtc3d(
                motion, plan, host=args.host, port=port, announce=announce, nul=bool(args.nul),
                seconds=args.seconds, missing=args.missing or "ff",
            )  # fmt: skip
        elif args.device == "ndi":
            from ...drivers.simulators.ndi_sim import run_ndi

            transport = "pty" if args.pty else "rfc2217" if args.rfc2217 else "tcp"
            run_ndi(
                motion, plan, transport=transport, host=args.host, port=port, announce=announce,
                model=args.model or "aurora", seconds=args.seconds,
            )  # fmt: skip
        else:
            from ...drivers.simulators.carstens_sim import run_carstens

            run_carstens(
                motion, plan, host=args.host, port=port, announce=announce, layout=args.layout or "ag501",
                seconds=args.seconds,
            )  # fmt: skip
    except KeyboardInterrupt:
        pass
    finally:
        signal.signal(signal.SIGTERM, before)
    return 0


def _pace_hz(args: argparse.Namespace) -> float | None:
    """What the device measures at; None = as fast as its recording."""
    return args.rate or (_usual_rate_hz(args) if DEVICES[args.device].own_pace else None)


def _usual_rate_hz(args: argparse.Namespace) -> float:
    return POLARIS_HZ if args.model == "polaris" else DEVICES[args.device].rate_hz


def _interrupt(signum: int, frame: object) -> None:
    raise KeyboardInterrupt


def _check_device(args: argparse.Namespace) -> None:
    """Options that would do nothing, and numbers that make no sense, are refused."""
    for kind, device in DEVICES.items():
        for option in device.options:
            if kind != args.device and getattr(args, option) is not None:
                raise InputError(
                    f"--{option} is for `simulate device {kind}`; {args.device} has no such thing."
                )
    for option in ("coils", "seed") if not args.synthetic else ("file_rate", "file_unit", "file_layout"):
        if getattr(args, option) is not None:
            instead = "--from RECORDING" if args.synthetic else "--synthetic"
            raise InputError(f"--{option.replace('_', '-')} goes with {instead}; leave it out.")
    if args.pty and args.rfc2217:
        raise InputError("--pty and --rfc2217 are two transports; choose one.")
    ranges = {
        "rate": (args.rate, 1.0, 5000.0),
        "port": (args.port, 0, 65535),
        "sensors": (args.sensors, 1, MOST_SENSORS),
        "seconds": (args.seconds, 0.0, 1e7),
    }
    for name, (value, low, high) in ranges.items():
        if value is not None and not low <= value <= high:
            raise InputError(f"--{name} {value:g}: expected {low:g} to {high:g}.")


def _opened(args: argparse.Namespace) -> Recording:
    from ...drivers import open_recording

    try:
        recording = open_recording(
            args.recording, rate_hz=args.file_rate, unit=args.file_unit, layout=args.file_layout
        )
    except InputError as reason:  # --rate is the device's here
        raise InputError(re.sub(r"--(rate|unit|layout)\b", r"--file-\1", str(reason))) from reason
    if recording.frame_count == 0:
        raise InputError(f"{args.recording}: no frames to play.")
    return recording


def _synthetic(args: argparse.Namespace) -> Recording:
    from ..simulation import Simulation, simulate

    roles = COILS if args.coils is None else args.coils
    recording, _ = simulate(
        Simulation(
            phones=tuple(PHONES.split()),
            coils=tuple(role for role in roles.replace(" ", "").split(",") if role),
            seconds=SYNTHETIC_S,
            rate_hz=args.rate or _usual_rate_hz(args),
            seed=1 if args.seed is None else args.seed,
        )
    )
    return recording


def _with_sensors(recording: Recording, count: int) -> Recording:
    """The first `count` coils, filled up with coils that lie still in a row, 5 mm apart."""
    import numpy as np

    have = len(recording.coils)
    extra = np.arange(max(0, count - have))
    row = np.column_stack([np.full(len(extra), 60.0), 5.0 * extra, np.zeros(len(extra))])
    still = np.broadcast_to(row, (recording.frame_count, len(extra), 3))
    quaternions = recording.quaternions
    if quaternions is not None:
        unknown = np.full((recording.frame_count, len(extra), 4), np.nan)
        quaternions = np.concatenate([quaternions, unknown], axis=1)[:, :count]
    return replace(
        recording,
        coils=(*recording.coils, *(f"still_{have + k + 1}" for k in extra))[:count],
        positions=np.concatenate([recording.positions, still], axis=1)[:, :count],
        orientations=None,
        quaternions=quaternions,
        rms=None,
        status=None,
    )
