"""The hard palate of every speaker, from the one scan that shows it (paper, "Tongue and palate shape estimation").

The template is matched to each scan by itself. In rounds, the palates then help each other: a PCA model of all of them
is fitted to each scan, within a narrow box, and from there the template is matched again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ... import InputError
from ..cloud import Cloud
from ..mesh import FloatArray
from ..neighbours import NeighbourRule, SurfaceIndex
from ..pca import PcaModel, fit_pca, pca_of
from ..procrustes import procrustes, rigid_motion
from .dataset import Landmarks
from .matching import Match, MatchSettings, match
from .scan import Scan
from .surface import otsu, surface_points
from .templates import Template, landmark_vertices, placed

AROUND_MM = 5.0  # of the palate: what its threshold comes from


@dataclass(frozen=True)
class PalatePriorSettings:
    """rounds: so often the palates are matched again; h: half the width of the model's box, in sigma; energies: of
    each of its fits. These are the paper's."""

    rounds: int = 1
    h: float = 1.0
    energies: int = 10


def palate_surface(scan: Scan, landmarks: Landmarks, template: Template) -> Cloud:
    """The surface of the tissue in a denoised scan, mm, with the threshold that fits around the palate.

    Its mucosa is hardly thicker than a voxel, between air and bone: darker than other tissue, so that the threshold for
    the whole scan puts its surface too deep, or misses it. Here it is Otsu's among the voxels near to where the
    landmarks put the template. Raises InputError where that is outside of the scan, or there is no surface.
    """
    from scipy.spatial import cKDTree

    where = np.indices(scan.values.shape).reshape(3, -1).T
    apart_mm = cKDTree(placed(template, landmarks)).query(scan.points(where), distance_upper_bound=AROUND_MM)[
        0
    ]
    around = scan.values.ravel()[apart_mm <= AROUND_MM]
    if not len(around):
        raise InputError(f"{scan.name}: the landmarks of the palate are outside of this scan.")
    return surface_points(scan, otsu(around))


def first_match(
    index: SurfaceIndex, landmarks: Landmarks, template: Template, settings: MatchSettings
) -> Match:
    """The template matched to a cloud, from where the landmarks (name -> (3,) mm) put it."""
    return match(placed(template, landmarks), template, index, landmarks, settings)


def palate_model(palates: Mapping[str, FloatArray], template: Template) -> PcaModel:
    """The PCA model of palates, speaker -> (n, 3) mm, brought together without a change of size.

    Raises InputError for fewer than two.
    """
    return pca_of(procrustes(np.array(list(palates.values())), template.mesh.vertices).shapes)


def start_of(
    model: PcaModel,
    previous: FloatArray,
    index: SurfaceIndex,
    landmarks: Landmarks,
    template: Template,
    rule: NeighbourRule,
    prior: PalatePriorSettings,
) -> FloatArray:
    """(n, 3) mm: the model fitted to a cloud, from where its palate was found before (n, 3)."""
    fit = fit_pca(
        model,
        template.mesh.faces,
        index,
        landmark_vertices(template, landmarks),
        prior.h,
        rule,
        rigid_motion(model.mean, previous),
        prior.energies,
    )
    return fit.vertices
