"""The steps from a scan to the mesh of its tongue, each from arguments to named arrays, as `caching` keeps them.

Every function here does the work of one scan (of one speaker where the palate is concerned), in whatever process. Points
are mm in the world of the scan, x left, y back, z up; those of clouds are kept in single precision (10 nm).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ..cloud import Cloud
from ..completion import held_out_errors
from ..mesh import FloatArray, Mesh, vertex_normals
from ..multilinear import TongueModel
from ..neighbours import SurfaceIndex
from ..pca import PcaModel
from ..procrustes import RigidMotion
from . import palates
from .bootstrapping import fitted
from .caching import Arrays, Source, Step
from .contact import ContactSettings, restore_contact
from .dataset import Landmarks, Region
from .diffusion import denoise
from .matching import Match, MatchSettings, match
from .palatealignment import ProfileSettings, align_palate
from .scan import Scan, read_scan
from .settings import DenoisingSettings, TonguePriorSettings
from .surface import surface_points
from .templates import Template, placed

Stored = Mapping[str, NDArray[Any]]
# Root mean square; 2 to 6 on phantoms, 8 to 20 with any two of the tongue's landmarks exchanged.
MOST_APART_MM = 9.0


def scan_at(path: Path, region: Region | None) -> Scan:
    """The scan, cropped, in 8-bit grey values. Raises InputError where it cannot be read."""
    scan = read_scan(path)
    if region is not None:
        scan = scan.cropped(region.low_mm, region.high_mm)
    return scan.quantised()


def denoised(file: Source, region: Region | None, settings: DenoisingSettings | None) -> Scan:
    """The same without its noise; as it is where settings is None."""
    scan = scan_at(file.path, region)
    if settings is None:
        return scan
    with_ = settings
    values = denoise(
        scan.values,
        scan.spacing_mm,
        with_.steps,
        with_.step_mm2,
        with_.contrast,
        with_.sigma_mm,
        with_.rho_mm,
    )
    return scan.holding(values)


def _surface(file: Source, region: Region | None, denoising: DenoisingSettings | None) -> Arrays:
    return _cloud_arrays(surface_points(denoised(file, region, denoising)))


def _palate_surface(
    file: Source,
    region: Region | None,
    denoising: DenoisingSettings | None,
    template: Template,
    landmarks: Landmarks,
) -> Arrays:
    return _cloud_arrays(palates.palate_surface(denoised(file, region, denoising), landmarks, template))


def _palate(cloud: Stored, template: Template, landmarks: Landmarks, settings: MatchSettings) -> Arrays:
    _check_landmarks(template, landmarks)
    index = SurfaceIndex(cloud_of(cloud))
    return match_arrays(palates.first_match(index, landmarks, template, settings))


def _palate_again(
    cloud: Stored,
    template: Template,
    landmarks: Landmarks,
    settings: MatchSettings,
    model: PcaModel,
    prior: palates.PalatePriorSettings,
    previous: Stored,
) -> Arrays:
    index = SurfaceIndex(cloud_of(cloud))
    start = palates.start_of(model, previous["vertices"], index, landmarks, template, settings.rule, prior)
    return match_arrays(match(start, template, index, landmarks, settings))


def _aligned(
    palate: Stored,
    template: Template,
    own: Source,
    own_region: Region | None,
    file: Source,
    region: Region | None,
    settings: ProfileSettings,
) -> Arrays:
    """The palate of one scan, brought to another one; itself where both are the same."""
    vertices = palate["vertices"]
    if own == file:
        return _alignment(vertices, 1.0, "")
    normals = vertex_normals(vertices, template.mesh.faces)
    found = align_palate(
        vertices, normals, scan_at(own.path, own_region), scan_at(file.path, region), settings
    )
    return _alignment(found.motion.apply(vertices), found.score, found.reason)


def _alignment(palate: FloatArray, score: float, reason: str) -> Arrays:
    return {
        "palate": palate,
        "score": np.array(score),
        "reason": np.frombuffer(reason.encode(), dtype=np.uint8),
    }


def _restored(cloud: Stored, aligned: Stored, template: Template, settings: ContactSettings) -> Arrays:
    palate = Mesh(aligned["palate"], template.mesh.faces)
    return _cloud_arrays(restore_contact(cloud_of(cloud), palate, settings))


def _matched(cloud: Stored, template: Template, landmarks: Landmarks, settings: MatchSettings) -> Arrays:
    """The first matching: from where the landmarks put the template."""
    _check_landmarks(template, landmarks)
    index = SurfaceIndex(cloud_of(cloud))
    return match_arrays(match(placed(template, landmarks), template, index, landmarks, settings))


def _check_landmarks(template: Template, landmarks: Landmarks) -> None:
    """Raises InputError where they are so far from the template's, brought to them, that some must be exchanged."""
    start = placed(template, landmarks)
    apart = {
        name: float(np.linalg.norm(start[template.landmarks[name]] - place))
        for name, place in landmarks.items()
    }
    apart_mm = float(np.sqrt(np.mean(np.square(list(apart.values())))))
    if apart_mm > MOST_APART_MM:
        worst = sorted(apart, key=lambda name: -apart[name])[:2]
        raise InputError(
            f"the landmarks of the {template.name} are {apart_mm:.0f} mm from where one has them, {' and '.join(worst)} "
            "most of all; are two of them exchanged, or left and right?"
        )


def _rematched(
    cloud: Stored,
    template: Template,
    landmarks: Landmarks,
    settings: MatchSettings,
    model: TongueModel,
    motion: RigidMotion,
    prior: TonguePriorSettings,
    previous: Stored,
) -> Arrays:
    """A round of bootstrapping: from where the fit of the model puts it. motion: from the scan to the head frame."""
    found = cloud_of(cloud)
    start = fitted(model, found, template, landmarks, motion, prior, settings.rule, previous["vertices"])
    return match_arrays(match(start, template, SurfaceIndex(found), landmarks, settings))


def _held_out(tensor: FloatArray, measured: NDArray[np.bool_]) -> Arrays:
    """Of measured cells of (speakers, phones, k) mm that were taken out: way of completing -> (c,) errors, mm."""
    errors = held_out_errors(np.where(measured[..., None], tensor, np.nan)).errors_mm
    return {way.replace(" ", "_"): one for way, one in errors.items()}


def match_arrays(found: Match) -> Arrays:
    return {
        "vertices": found.vertices,
        "residual_mm": np.array(found.residual_mm),
        "valid": np.array(found.valid),
        "flipped": np.array(found.flipped),
    }


def cloud_of(arrays: Stored) -> Cloud:
    return Cloud(arrays["points"].astype(np.float64), arrays["normals"].astype(np.float64))


def _cloud_arrays(cloud: Cloud) -> Arrays:
    assert cloud.normals is not None
    return {"points": cloud.points.astype(np.float32), "normals": cloud.normals.astype(np.float32)}


SURFACE = Step("surface", 1, _surface)
PALATE_SURFACE = Step("palate surface", 1, _palate_surface)
PALATE = Step("palate", 1, _palate)
PALATE_AGAIN = Step("palate again", 1, _palate_again)
ALIGNED = Step("aligned", 1, _aligned)
RESTORED = Step("restored", 1, _restored)
MATCHED = Step("matched", 1, _matched)
REMATCHED = Step("rematched", 1, _rematched)
HELD_OUT = Step("held out", 1, _held_out)
