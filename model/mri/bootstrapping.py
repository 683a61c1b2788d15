"""One tongue helps the others: a model of all meshes so far is the start for matching each of them again.

(Paper, "Tongue and palate shape estimation" and "Preparing the training mesh collection".) The heads are brought
together by the palates; in that frame the tongues make a multilinear model, which is fitted to the points of each scan
within a narrow box: what no other tongue does, it cannot do either. From there the template is matched anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..build import TrainingShapes, fill_missing_by_averaging, model_from_shapes
from ..cloud import Cloud
from ..completion import fill_missing_by_low_rank
from ..fitting import fit_clouds, fit_shapes
from ..mesh import FloatArray
from ..multilinear import TongueModel
from ..neighbours import NeighbourRule
from ..procrustes import RigidMotion, carried_over, procrustes
from .dataset import Landmarks
from .settings import TonguePriorSettings
from .templates import Template, landmark_vertices

Cell = tuple[str, str]


def head_motions(
    palates: Mapping[str, FloatArray], in_scans: Mapping[Cell, FloatArray], template: Template
) -> dict[Cell, RigidMotion]:
    """What brings each scan, with all that is in it, into the frame of the palate template, which all heads share.

    palates: speaker -> (p, 3) mm as extracted; in_scans: (speaker, phone) -> (p, 3) the same, brought into that scan.
    """
    speakers = list(palates)
    aligned = procrustes(np.array([palates[name] for name in speakers]), template.mesh.vertices).shapes
    whose = [speakers.index(speaker) for speaker, _ in in_scans]
    motions = carried_over(np.array(list(in_scans.values())), whose, aligned)
    return dict(zip(in_scans, motions, strict=True))


def complete_shapes(
    tongues: Mapping[Cell, FloatArray],
    speakers: Sequence[str],
    phones: Sequence[str],
    template: Template,
    completion: str,
    provenance: Mapping[str, str],
) -> TrainingShapes:
    """The tongues, (speaker, phone) -> (n, 3) mm in the head frame, as a tensor without gaps.

    completion: "averaging" (the paper's) or "low rank". Raises InputError for a speaker or a phone without any tongue.
    """
    tensor = np.full((len(speakers), len(phones), template.mesh.vertices.size), np.nan)
    for (speaker, phone), vertices in tongues.items():
        tensor[speakers.index(speaker), phones.index(phone)] = vertices.ravel()
    averaged, missing = fill_missing_by_averaging(tensor)
    complete = averaged if completion == "averaging" else fill_missing_by_low_rank(tensor).tensor
    return TrainingShapes(
        complete,
        template.mesh.faces,
        tuple(speakers),
        tuple(phones),
        tuple((speakers[i], phones[j]) for i, j in missing),
        template.marks,
        provenance,
    )


def model_of(shapes: TrainingShapes, speaker_modes: int, pose_modes: int) -> TongueModel:
    """With so many weights, or as many as there are speakers and phones if those are fewer."""
    speakers, phones, _ = shapes.tensor.shape
    return model_from_shapes(shapes, min(speaker_modes, speakers), min(pose_modes, phones))


def fitted(
    model: TongueModel,
    cloud: Cloud,
    template: Template,
    landmarks: Landmarks,
    motion: RigidMotion,
    settings: TonguePriorSettings,
    rule: NeighbourRule,
    previous: FloatArray,
) -> FloatArray:
    """(n, 3) mm: the model, fitted to the points of a scan and brought into its world.

    cloud, landmarks: in the world of the scan; motion: from there to the model's frame; previous: (n, 3) what the
    template was matched to before, where neighbours are first sought. Raises InputError where the cloud is not where
    the model is.
    """
    assert cloud.normals is not None
    marked = {v: motion.apply(place) for v, place in landmark_vertices(template, landmarks).items()}
    there = Cloud(motion.apply(cloud.points), cloud.normals @ motion.rotation.T, marked)
    start = fit_shapes(model, motion.apply(previous)[None], settings.h)
    fit = fit_clouds(model, [there], settings.h, settings.energies, rule, start)
    return inverse(motion).apply(model.vertices(fit.speaker, fit.poses[0]))


def inverse(motion: RigidMotion) -> RigidMotion:
    return RigidMotion(motion.rotation.T, -motion.rotation.T @ motion.shift)
