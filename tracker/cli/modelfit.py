"""`tonguetrack model fit`: a model fitted to one surface."""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import InputError
from .names import keep_apart, named_model, prepare_folder

if TYPE_CHECKING:
    from ...model.cloud import Cloud
    from ...model.fitting import Fit
    from ...model.mesh import FloatArray, Mesh
    from ...model.multilinear import Mode, TongueModel

REACHED = 1e-6  # of a box: nearer to its wall a weight counts as held by it
HEADER_BYTES = 64 * 1024


def add_verb(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `model fit`."""
    fit = verbs.add_parser(
        "fit",
        help="find the weights whose shape is nearest to a mesh or a point cloud",
        description="A mesh with the model's own vertices and faces is fitted vertex by vertex; any other mesh, and a "
        "point cloud, to its nearest points, in ten rounds. Nothing is moved: the surface has to be in the model's frame.",
    )
    fit.add_argument("model", metavar="MODEL", help="a model file, or 'bundled'")
    fit.add_argument("target", metavar="TARGET", help="a mesh (.ply, .obj) or a point cloud (.ply), in mm")
    fit.add_argument(
        "--landmarks", metavar="FILE.csv",
        help="where landmarks of the model are (name,x_mm,y_mm,z_mm), for surfaces with other vertices; a name is one of the "
        "model's, or the number of a vertex",
    )  # fmt: skip
    fit.add_argument(
        "--box", type=float, default=2.0, metavar="H",
        help="how far a weight may be from its mean, in deviations of the training weights (default 2)",
    )  # fmt: skip
    fit.add_argument("-o", "--output", metavar="MESH", help="write the fitted mesh there (.ply, .obj)")
    fit.add_argument("--json", action="store_true", help="everything as JSON on stdout")
    fit.set_defaults(run=run_fit)


def run_fit(args: argparse.Namespace) -> int:
    from ...atomic import write_atomically
    from ...model.fitting import fit_clouds, fit_shapes
    from ...model.mesh import MESH_SUFFIXES, Mesh, mesh_bytes
    from ..speakers import check_place

    target, output = Path(args.target), Path(args.output) if args.output else None
    if output:
        if output.suffix.lower() not in MESH_SUFFIXES:
            raise InputError(f"{output}: a mesh is written as .ply or .obj; end the name in one.")
        keep_apart([output], [target, Path(args.model), *([Path(args.landmarks)] if args.landmarks else [])])
        prepare_folder(output)
    model = named_model(args.model)
    surface = read_surface(target)
    registered = _registered(surface, model)
    if registered is not None:
        if args.landmarks:
            raise InputError(
                f"--landmarks: {target} has the model's own vertices, every one of which is known; leave the "
                "landmarks out."
            )
        fit = fit_shapes(model, registered[None], args.box)
    else:
        marks = landmark_places(Path(args.landmarks), model) if args.landmarks else {}
        fit = fit_clouds(model, [_cloud(surface, marks)], args.box)
    check_place(model, fit)
    found = summarise(
        model, fit, args.box, "vertex by vertex" if registered is not None else "nearest points"
    )
    if args.json:
        print(
            json.dumps(
                {"model": model.name, "model_fingerprint": model.fingerprint, "target": str(target), **found}
            )
        )
    else:
        print("\n".join(described(found, f"{target}: {model.name} [{model.fingerprint}]")))
    if output:
        mesh = Mesh(model.vertices(fit.speaker, fit.poses[0]), model.faces)
        print(f"  written: {write_atomically(output, mesh_bytes(mesh, output.suffix))}", file=sys.stderr)
    return 0


def read_surface(path: Path) -> Mesh | Cloud:
    """A mesh; a cloud where a PLY file has no faces."""
    from ...model.mesh import read_mesh
    from ...model.mri.cloudfile import read_cloud

    if path.suffix.lower() == ".ply" and path.is_file():
        with path.open("rb") as stream:
            header = stream.read(HEADER_BYTES).partition(b"end_header")[0]
        if not re.search(rb"element\s+face\s+0*[1-9]", header):
            return read_cloud(path)
    return read_mesh(path)


def landmark_places(path: Path, model: TongueModel) -> dict[int, FloatArray]:
    """Vertex of the model -> (3,) mm, from a file of landmarks by name or by number."""
    from ...model.mri.dataset import read_landmarks

    places = {}
    for name, place in read_landmarks(path).items():
        if name not in model.marks.landmarks and not name.isdecimal():
            known = ", ".join(model.marks.landmarks) or "none"
            raise InputError(
                f"{path}: the model '{model.name}' has no landmark '{name}'; its landmarks are {known}; a number names a "
                "vertex."
            )
        places[model.marks.landmarks[name] if name in model.marks.landmarks else int(name)] = place
    return places


def _registered(surface: Mesh | Cloud, model: TongueModel) -> FloatArray | None:
    """(V, 3) where the surface has the model's own vertices and faces."""
    import numpy as np

    from ...model.mesh import Mesh

    if not isinstance(surface, Mesh) or len(surface.vertices) != model.vertex_count:
        return None
    return surface.vertices if np.array_equal(surface.faces, model.faces) else None


def _cloud(surface: Mesh | Cloud, landmarks: dict[int, FloatArray]) -> Cloud:
    from ...model.cloud import Cloud
    from ...model.mesh import Mesh, vertex_normals

    if isinstance(surface, Mesh):
        return Cloud(surface.vertices, vertex_normals(surface.vertices, surface.faces), landmarks)
    return Cloud(surface.points, surface.normals, landmarks)


def summarise(model: TongueModel, fit: Fit, box: float, how: str) -> dict[str, Any]:
    """The fit as plain values."""
    return {
        "fitted": how,
        "box": box,
        "residual_mm": float(fit.residual_mm[0]),
        "share_of_vertices": float(fit.used[0]),
        "converged": bool(fit.converged),
        "speaker": _weights(model.speaker, fit.speaker, box),
        "pose": _weights(model.pose, fit.poses[0], box),
    }


def _weights(mode: Mode, weights: FloatArray, box: float) -> dict[str, Any]:
    from ...model.fitting import allowed_reach

    reach = allowed_reach(mode, box)
    return {
        "weights": weights.tolist(),
        "normalised": mode.normalised(weights).tolist(),
        "at_the_box": (abs(weights - mode.mean) >= reach * (1 - REACHED)).tolist(),
    }


def described(found: dict[str, Any], heading: str) -> list[str]:
    """The lines that people read."""
    lines = [heading]
    lines.append(
        f"  fitted {found['fitted']}; {100 * found['share_of_vertices']:.0f} % of the vertices took part; mean distance "
        f"{found['residual_mm']:.2f} mm"
    )
    for mode in ("speaker", "pose"):
        weights = found[mode]
        cells = (
            f"{value:+.2f}{'*' if held else ''}"
            for value, held in zip(weights["normalised"], weights["at_the_box"], strict=True)
        )
        lines.append(f"  {mode:7} {'  '.join(cells)}  sigma")
    if any(found["speaker"]["at_the_box"] + found["pose"]["at_the_box"]):
        lines.append(f"  * held by the box of {found['box']:g} deviations")
    if not found["converged"]:
        lines.append("  the descent did not come to rest; the weights may be off")
    return lines
