"""The tongue that the page shows: its model, sent once, and what is drawn around it."""

from __future__ import annotations

import numpy as np

from .... import InputError
from ....model import load_model
from ....model.midsagittal import midsagittal_vertices
from ....model.multilinear import TongueModel
from ....model.rebasing import Rebased
from ...bundled import bundled_model
from ...pose import FloatArray
from ...session import Session, parse_session
from ..feed import FeedAbout

SIGMAS = 5.0
"""The weights that become 0 and 1 in `model.glb`: as far from the mean as the tracker lets them be."""


class Anatomy:
    """One speaker's tongue as `model.glb`, with its number; `follow` makes another one for another speaker.

    Raises InputError where the feed's model or session cannot be read, or do not belong to its poses.
    """

    def __init__(self, about: FeedAbout) -> None:
        self.model = model = _model_of(about)
        self.session: Session = parse_session(about.session, "the run's session")
        if about.coefficients != model.pose.size or about.speaker_weights != model.speaker.size:
            raise InputError(
                f"the poses have {about.coefficients} coefficients and {about.speaker_weights} speaker weights, but "
                f"the model '{model.name}' has {model.pose.size} and {model.speaker.size}."
            )
        if any(not 0 <= vertex < model.vertex_count for vertex in about.correspondences):
            raise InputError(f"a coil sits on a vertex that the model '{model.name}' does not have.")
        self.rebased = Rebased.of_range(model.pose.mean, model.pose.sigma, SIGMAS)
        self.contour = tuple(int(vertex) for vertex in midsagittal_vertices(model))
        palate = self.session.palate
        self.palate: FloatArray | None = None if palate is None else palate.points_mm
        stated = self.session.speaker_weights
        self.speaker_weights = np.array(model.speaker.mean if stated is None else stated)
        self.number = 1
        self.glb = self._made(self.speaker_weights)

    def fits(self, speaker_weights: FloatArray) -> bool:
        """Whether `model.glb` is this speaker (m,)."""
        return bool(np.array_equal(self.speaker_weights, speaker_weights))

    def vertices(self, speaker_weights: FloatArray, weights: FloatArray) -> FloatArray:
        """(V, 3) mm of any speaker in any pose."""
        return self.model.vertices(speaker_weights, weights)

    def follow(self, speaker_weights: FloatArray) -> None:
        """Makes `model.glb` this speaker. Takes some milliseconds; may run in another thread."""
        glb = self._made(speaker_weights)
        self.glb, self.speaker_weights = glb, speaker_weights.copy()
        self.number += 1

    def _made(self, speaker_weights: FloatArray) -> bytes:
        from ...gltf import glb

        return glb(self.model.for_speaker(speaker_weights), self.rebased, self.model.name)


def _model_of(about: FeedAbout) -> TongueModel:
    return bundled_model() if about.model == "bundled" else load_model(about.model)
