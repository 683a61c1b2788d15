"""A run that clients of the paper's authors' live server drive: they name the vertices and turn the knobs.

Their points are in the model's frame and every one is believed; the energy is theirs until a session says
otherwise: no bias, coherence 1, a box of one sigma.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from .. import InputError
from ..drivers.frames import CoilFrame, SourceNote
from ..model.multilinear import TongueModel
from .online import Tracker
from .preparation import Preparation
from .session import Energy, Session
from .setup import Setup

AUTHORS_ENERGY = Energy(
    beta_speaker=0.0, beta_pose=0.0, gamma_speaker=1.0, gamma_pose=1.0, box=1.0
)  # the defaults of their program


def setup_for_points(
    model: TongueModel, coils: Sequence[str], vertices: Sequence[int], session: Session | None
) -> Setup:
    """The set-up for points at these vertices, in ascending order. session: only its energy and speaker are used.

    Raises InputError where the model has no such vertex.
    """
    for vertex in vertices:
        if not 0 <= vertex < model.vertex_count:
            raise InputError(
                f"the client named the vertex {vertex}, but the model '{model.name}' has vertices 0 to "
                f"{model.vertex_count - 1}; start it with the model that the client was made for."
            )
    stated = session or Session(energy=AUTHORS_ENERGY)
    own = Session(
        energy=stated.energy,
        speaker_weights=stated.speaker_weights,
        speaker_source=stated.speaker_source,
        model_fingerprint=model.fingerprint,
        source=stated.source,
    )
    roles = tuple(name.replace(" ", "_") for name in coils)
    preparation = Preparation(np.arange(len(vertices)), own.alignment)
    return Setup(tuple(coils), roles, tuple(int(v) for v in vertices), preparation, own, ())


def next_vertices(source: Iterable[CoilFrame | SourceNote]) -> None:
    """Reads on until a client names vertices, or the source ends."""
    for item in source:
        if isinstance(item, SourceNote) and item.command == "set_vertices":
            return


def obey_client(note: SourceNote, tracker: Tracker) -> Setup | None:
    """The set-up that a client's command asks for; None where it needs a new run, with other points."""
    setup = tracker.setup
    if note.command == "set_vertices":
        return setup if tuple(int(v) for v in note.values) == setup.vertices else None
    if note.command == "fix_speaker":
        tracker.fix_average()
        return tracker.setup
    if note.command == "reset":
        tracker.free_speaker()
        tracker.restart()
        return tracker.setup
    if note.command == "set_settings":
        names = ("gamma_speaker", "gamma_pose", "box")
        stated = {n: v for n, v in zip(names, note.values, strict=False) if not math.isnan(v)}
        try:
            energy = replace(setup.session.energy, **stated)
        except InputError:
            return setup  # a client's impossible value changes nothing
        return replace(setup, session=replace(setup.session, energy=energy))
    return setup
