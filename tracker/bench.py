"""How fast, and how exact: the solvers against scipy on the same frames, the loop against the clock.

Every comparison is made in one run on one machine, in short turns, from the same warm start and for the
same energy. The frames are made from the model itself: smooth weights, five vertices, 0.5 mm of noise.
"""

from __future__ import annotations

import json
import os
import platform
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import InputError, __version__
from ..drivers.frames import Recording
from ..drivers.replay import ReplaySource
from ..model.multilinear import Mode, TongueModel
from .live import run_live, stream_info
from .online import Tracker
from .pose import FloatArray
from .preparation import Preparation
from .session import Energy, Session
from .setup import Setup
from .solver import FixedSpeakerSolver, FreeSpeakerSolver
from .streams.osc import OscSink

COILS = 5
NOISE_MM = 0.5
TURN = 25  # frames that one solver gets before the other has its turn
ALONE_PASSES = 20
RATES_HZ = (250.0, 400.0, 1250.0)
HOUR_FRAMES = 3600 * 250
TIGHT = {"ftol": 1e-16, "gtol": 1e-10, "maxiter": 10000, "maxfun": 100000}


def bench(
    model: TongueModel, model_path: Path, frames: int = 300, seconds: float = 4.0, batch: int = 100_000
) -> dict[str, Any]:
    """All measurements, as plain values. Takes less than a minute on two cores."""
    return {
        "machine": machine(),
        "model": f"{model.name} ({model.speaker.size} + {model.pose.size} weights)",
        "solves": {
            "fixed_speaker": solve_comparison(model, True, frames),
            "free_speaker": solve_comparison(model, False, frames),
        },
        "batch": batch_throughput(model, batch),
        "loop": [loop_latency(model, rate_hz, seconds) for rate_hz in RATES_HZ],
        "start": start_times(model_path),
    }


def machine() -> dict[str, Any]:
    import numba
    import scipy

    return {
        "tonguetrack": __version__,
        "cpus": os.cpu_count(),
        "machine": platform.machine(),
        "system": platform.system(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
        "scipy": scipy.__version__,
    }


def made_up_recording(model: TongueModel, frames: int, rate_hz: float) -> tuple[Recording, Setup]:
    """A recording of COILS coils on the model's own surface, and the complete set-up for it."""
    chosen = model.marks.midsagittal or tuple(range(model.vertex_count))
    places = np.linspace(0, len(chosen) - 1, min(COILS, len(chosen))).astype(int)
    vertices = tuple(int(chosen[place]) for place in places)
    names = tuple(f"coil_{k}" for k in range(len(vertices)))
    random = np.random.default_rng(20)
    speaker = model.speaker.mean + 0.5 * _spread(model.speaker) * random.standard_normal(model.speaker.size)
    times_s = np.arange(frames) / rate_hz
    hz = random.uniform(0.7, 4.0, model.pose.size)
    swing = np.sin(2 * np.pi * (hz * times_s[:, None] + random.random(model.pose.size)))
    poses = model.pose.mean + _spread(model.pose) * swing
    at_coils = model.for_speaker(speaker).at(vertices)
    points = (at_coils.base + poses @ at_coils.directions).reshape(frames, -1, 3)
    points += NOISE_MM * random.standard_normal(points.shape)
    recording = Recording(names, points, times_s, rate_hz, "made up", source="made-up recording")
    session = Session(
        coils={name: name for name in names},
        correspondences=dict(zip(names, vertices, strict=True)),
        speaker_weights=speaker,
    )
    picked = np.arange(len(vertices), dtype=np.int64)
    return recording, Setup(names, names, vertices, Preparation(picked, session.alignment), session, ())


# Solves ---------------------------------------------------------------------------------------------


def solve_comparison(model: TongueModel, fixed: bool, frames: int) -> dict[str, Any]:
    """One frame's solve, called from Python: ours, and scipy's L-BFGS-B with its default and with tight
    tolerances, in turns; afterwards ours alone, over and over. Energy differences are (ours - scipy) / scipy
    at the points both ended in; below 0 ours is lower. Times in us."""
    from scipy.optimize import minimize

    recording, setup = made_up_recording(model, frames, 250.0)
    energy = Energy()
    solver, objective, bounds = _problem(model, setup, energy, fixed)
    coils = recording.positions
    solver.solve(coils[0])  # warm: everything from here on has a previous frame
    starts = np.empty((frames, len(solver.weights)))
    ours = np.empty_like(starts)
    took_us: dict[str, list[float]] = {"ours": [], "scipy_default": [], "scipy_tight": []}
    differences: dict[str, list[float]] = {"scipy_default": [], "scipy_tight": []}
    settings: dict[str, Any] = {"scipy_default": {}, "scipy_tight": TIGHT}
    for begin in range(0, frames, TURN):
        turn = range(begin, min(begin + TURN, frames))
        for t in turn:
            starts[t] = solver.weights
            before = time.perf_counter_ns()
            solver.solve(coils[t])
            took_us["ours"].append((time.perf_counter_ns() - before) * 1e-3)
            ours[t] = solver.weights
        for name, options in settings.items():
            for t in turn:
                arguments = (coils[t].ravel(), starts[t])
                before = time.perf_counter_ns()
                found = minimize(
                    objective,
                    starts[t],
                    arguments,
                    method="L-BFGS-B",
                    jac=True,
                    bounds=bounds,
                    options=options,
                )
                took_us[name].append((time.perf_counter_ns() - before) * 1e-3)
                theirs = objective(found.x, *arguments)[0]
                differences[name].append((objective(ours[t], *arguments)[0] - theirs) / theirs)
    took_us["ours_alone"] = []
    for _ in range(ALONE_PASSES):
        for frame in coils:
            before = time.perf_counter_ns()
            solver.solve(frame)
            took_us["ours_alone"].append((time.perf_counter_ns() - before) * 1e-3)
    median = {name: float(np.median(values)) for name, values in took_us.items()}
    return {
        "weights": len(solver.weights),
        "coils": coils.shape[1],
        "frames": frames,
        **{f"{name}_us": _spread_of(values) for name, values in took_us.items()},
        "ratio_to_scipy_default": median["scipy_default"] / median["ours"],
        "ratio_to_scipy_tight": median["scipy_tight"] / median["ours"],
        **{
            f"energy_difference_to_{name}": {"median": float(np.median(v)), "largest": float(np.max(v))}
            for name, v in differences.items()
        },
    }


Objective = Callable[[FloatArray, FloatArray, FloatArray], tuple[float, FloatArray]]


def _problem(
    model: TongueModel, setup: Setup, energy: Energy, fixed: bool
) -> tuple[FixedSpeakerSolver | FreeSpeakerSolver, Objective, list[tuple[float, float]]]:
    """Our solver, and the same energy with its gradient as scipy wants it, in numpy, all coils present."""
    at_coils = model.at(setup.vertices)
    speakers = model.speaker.size
    alpha = energy.alpha / len(setup.vertices)
    modes = [model.pose] if fixed else [model.speaker, model.pose]
    mean = np.concatenate([mode.mean for mode in modes])
    sigma = np.concatenate([mode.sigma for mode in modes])
    beta = np.full(len(mean), energy.beta_pose)
    gamma = np.full(len(mean), energy.gamma_pose)
    bounds = list(zip(mean - energy.box * sigma, mean + energy.box * sigma, strict=True))

    def priors(x: FloatArray, previous: FloatArray) -> tuple[float, FloatArray]:
        off_mean, off_previous = x - mean, x - previous
        value = float(beta @ off_mean**2 + gamma @ off_previous**2)
        return value, 2.0 * (beta * off_mean + gamma * off_previous)

    if fixed:
        weights = setup.session.speaker_weights
        assert weights is not None
        speaker = model.for_speaker(weights).at(setup.vertices)

        def fixed_energy(x: FloatArray, q: FloatArray, previous: FloatArray) -> tuple[float, FloatArray]:
            residual = speaker.base + x @ speaker.directions - q
            value, gradient = priors(x, previous)
            value += alpha * float(residual @ residual)
            return value, gradient + 2.0 * alpha * (speaker.directions @ residual)

        return FixedSpeakerSolver(speaker, energy), fixed_energy, bounds

    beta[:speakers], gamma[:speakers] = energy.beta_speaker, energy.gamma_speaker
    core, rows = at_coils.core, at_coils.origin.size
    by_speaker = np.ascontiguousarray(core.reshape(speakers, -1))

    def free_energy(x: FloatArray, q: FloatArray, previous: FloatArray) -> tuple[float, FloatArray]:
        directions = (x[:speakers] @ by_speaker).reshape(-1, rows)
        residual = at_coils.origin + x[speakers:] @ directions - q
        value, gradient = priors(x, previous)
        value += alpha * float(residual @ residual)
        pulled = core @ residual  # (m, n)
        gradient[:speakers] += 2.0 * alpha * (pulled @ x[speakers:])
        gradient[speakers:] += 2.0 * alpha * (directions @ residual)
        return value, gradient

    return FreeSpeakerSolver(at_coils, energy), free_energy, bounds


# Batch, loop, start ---------------------------------------------------------------------------------


def batch_throughput(model: TongueModel, frames: int) -> dict[str, Any]:
    """A whole take in the compiled loop, preparation included; best of three, in us a frame."""
    recording, setup = made_up_recording(model, frames, 250.0)
    weights = setup.session.speaker_weights
    assert weights is not None
    solvers: dict[str, FixedSpeakerSolver | FreeSpeakerSolver] = {
        "fixed_speaker": FixedSpeakerSolver(model.for_speaker(weights).at(setup.vertices), Energy()),
        "free_speaker": FreeSpeakerSolver(model.at(setup.vertices), Energy()),
    }
    result: dict[str, Any] = {"frames": frames}
    for name, solver in solvers.items():
        solver.solve_all(setup.preparation.all_frames(recording.positions[:10]))  # compiled or loaded
        best = float("inf")
        for _ in range(3):
            before = time.perf_counter()
            solver.solve_all(setup.preparation.all_frames(recording.positions))
            best = min(best, time.perf_counter() - before)
        result[name] = {"us_a_frame": best / frames * 1e6, "hour_at_250_hz_s": best / frames * HOUR_FRAMES}
    return result


_RECEIVER = """
import socket, sys
receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4194304)
receiver.bind(("127.0.0.1", 0))
print(receiver.getsockname()[1], flush=True)
receiver.settimeout(30)
frames = 0
while (datagram := receiver.recv(2048)) != b"end":
    frames += b"/tongue/frame" in datagram
print(frames)
"""


def loop_latency(model: TongueModel, rate_hz: float, seconds: float) -> dict[str, Any]:
    """The real loop in real time: replay, track, send over UDP to a receiver in another process."""
    recording, setup = made_up_recording(model, int(rate_hz * seconds), rate_hz)
    receiver = subprocess.Popen([sys.executable, "-c", _RECEIVER], stdout=subprocess.PIPE, text=True)
    try:
        assert receiver.stdout is not None
        port = int(receiver.stdout.readline())
        sink = OscSink(f"127.0.0.1:{port}")
        with ReplaySource(recording) as source:
            summary = run_live(source, Tracker(model, setup), stream_info(model, setup, rate_hz), [sink])
        sink.close()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as last:
            last.sendto(b"end", ("127.0.0.1", port))
        received = int(receiver.communicate(timeout=10)[0])
    finally:
        receiver.kill()
        receiver.wait()
    return {
        "rate_hz": rate_hz,
        "reached_hz": summary.rate_hz,
        "frames": summary.frames,
        "received": received,
        "arrival_to_sent_ms": summary.arrival_to_sent_ms,
        "solve_us": summary.solve_us,
        "replay_late_by_ms": summary.lateness_ms,
    }


def start_times(model_path: Path) -> dict[str, Any]:
    """Fresh processes: from nothing to the first tracked frame, with an empty and with a filled cache of
    compiled code. In s."""
    # -P: of the installed package, also where the working folder is the checkout.
    code = f"from {__name__} import first_frame; first_frame()"
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
        result = {}
        for name in ("cold", "warm"):
            begin = time.time()
            run = subprocess.run(
                [sys.executable, "-P", "-c", code, str(model_path), repr(begin)],
                env=environment,
                capture_output=True,
                text=True,
                check=False,
            )
            if run.returncode:
                raise InputError(f"the start could not be measured: {run.stderr.strip().splitlines()[-1]}")
            result[name] = json.loads(run.stdout)
    return result


def first_frame() -> None:
    """Run by `start_times` in a process of its own: prints how long each step to the first pose took."""
    imported = time.time()
    from ..model import load_model

    model = load_model(sys.argv[1])
    recording, setup = made_up_recording(model, 2, 250.0)
    loaded = time.time()
    tracker = Tracker(model, setup)
    tracker.warm_up()
    ready = time.time()
    with ReplaySource(recording, speed=None) as source:
        tracker.step(next(source))
    end = time.time()
    begin = float(sys.argv[2])
    steps = {"imports": imported - begin, "model": loaded - imported, "solver": ready - loaded}
    print(json.dumps({**steps, "first_frame": end - ready, "total": end - begin}))


def report(result: dict[str, Any]) -> str:
    """The measurements as Markdown, for people."""
    about = result["machine"]
    lines = [
        ", ".join(f"{name} {value}" for name, value in about.items()),
        f"model: {result['model']}",
        "",
        "| one solve, called from Python | median us | p99 us | scipy / ours | our energy above scipy's, largest |",
        "|---|---|---|---|---|",
    ]
    for kind, solve in result["solves"].items():
        title = f"{kind.replace('_', ' ')}, {solve['weights']} weights, {solve['coils']} coils"
        for label, name in ((title, "ours"), ("the same, without turns", "ours_alone")):
            values = solve[f"{name}_us"]
            lines.append(f"| {label} | {values['median']:.2f} | {values['p99']:.2f} | | |")
        for name in ("scipy_default", "scipy_tight"):
            values, ratio = solve[f"{name}_us"], solve[f"ratio_to_{name}"]
            largest = solve[f"energy_difference_to_{name}"]["largest"]
            label = name.replace("scipy_", "scipy L-BFGS-B, ")
            lines.append(
                f"| {label} | {values['median']:.0f} | {values['p99']:.0f} | {ratio:.0f} | {largest:+.1e} |"
            )
    lines += [
        "",
        f"| batch of {result['batch']['frames']} frames | us a frame | an hour at 250 Hz, s |",
        "|---|---|---|",
    ]
    for kind in ("fixed_speaker", "free_speaker"):
        values = result["batch"][kind]
        name = kind.replace("_", " ")
        lines.append(f"| {name} | {values['us_a_frame']:.2f} | {values['hour_at_250_hz_s']:.1f} |")
    lines += [
        "",
        "| loop, paced | arrival to sent p50 ms | p99 ms | max ms | replay late p50 ms | p99 ms | received |",
        "|---|---|---|---|---|---|---|",
    ]
    for loop in result["loop"]:
        sent, late = loop["arrival_to_sent_ms"], loop["replay_late_by_ms"]
        lines.append(
            f"| {loop['rate_hz']:g} Hz | {sent['p50']:.3f} | {sent['p99']:.3f} | {sent['max']:.2f} | "
            f"{late['p50']:.3f} | {late['p99']:.3f} | {loop['received']} of {loop['frames']} |"
        )
    lines += [
        "",
        "| start, s | imports | model | solver | first frame | total |",
        "|---|---|---|---|---|---|",
    ]
    for name, steps in result["start"].items():
        values = (steps[key] for key in ("imports", "model", "solver", "first_frame", "total"))
        lines.append(f"| {name} cache | " + " | ".join(f"{value:.4f}" for value in values) + " |")
    return "\n".join(lines)


def _spread(mode: Mode) -> FloatArray:
    """(w,) how far weights really vary; a third of the nominal sigma where the model does not tell."""
    return mode.sigma / 3.0 if mode.measured_sigma is None else mode.measured_sigma


def _spread_of(values: Sequence[float]) -> dict[str, float]:
    median, p99 = np.percentile(values, [50.0, 99.0])
    return {"median": float(median), "p99": float(p99), "largest": float(np.max(values))}
