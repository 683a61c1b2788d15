"""How good a model of a sample database is: compactness, generalisation, specificity (paper, section "Model analysis").

compactness      the share of the variance that the first components of a mode explain together
generalisation   how near it comes to what it was built without (`generalisation`)
specificity      how near its random shapes are to real ones, in a region (`specificity`)
fixed phones     the same with each phone's pose, in the region that is critical for the phone
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from .. import InputError
from .build import TrainingShapes
from .curves import Curve, Progress, silent
from .generalisation import POSE, SPEAKER, generalisation
from .mesh import FloatArray
from .specificity import SAMPLES, check_region, phone_specificity, specificity
from .tensor import cumulative_compactness, hosvd

COMPACTNESS, GENERALISATION, SPECIFICITY, PHONES = "compactness", "generalisation", "specificity", "phones"
MEASURES = (COMPACTNESS, GENERALISATION, SPECIFICITY, PHONES)
MODES = (POSE, SPEAKER)

WHOLE_MESH = "whole mesh"
SPEECH, VOWEL, SIBILANT = "combined", "bladebackdorsum", "bladetip"
UNIONS: Mapping[str, tuple[str, ...]] = {
    SPEECH: ("tip", "blade", "back", "dorsum", "lateral"),
    VOWEL: ("blade", "back", "dorsum"),
    SIBILANT: ("tip", "blade"),
}
"""Regions by the names of the authors' files, and what they consist of (paper, "Specificity"; the whole of the speech
related parts, what is critical for vowels, and for sibilants)."""
CRITICAL: Mapping[str, str] = dict.fromkeys("ieɛaɑʌɔouʉə", VOWEL) | dict.fromkeys("sʃ", SIBILANT)
"""Phone -> the region that is critical for it."""


@dataclass(frozen=True)
class Settings:
    """How to measure; the paper's settings.

    measures: of MEASURES; speaker_modes, pose_modes: components of the mode that is not varied; h: the box of the
    generalisation's fits in sigma; samples: of each row of specificity; region: its name, None = `combined` where it is
    known, else the whole mesh; seed: of the samples; jobs: processes, -1 = one for each core.
    """

    measures: frozenset[str] = frozenset(MEASURES)
    speaker_modes: int = 5
    pose_modes: int = 4
    h: float = 2.0
    samples: int = SAMPLES
    region: str | None = None
    seed: int = 1
    jobs: int = -1

    def held(self, mode: str) -> int:
        """How many components the other mode has while this one is varied."""
        return self.pose_modes if mode == SPEAKER else self.speaker_modes


@dataclass(frozen=True)
class Evaluation:
    """What was measured; empty where it was not asked for.

    compactness: mode -> (entries,) cumulative shares; generalisation, specificity: mode -> curve; phones: phone ->
    curve over the speaker components; region: what specificity was measured on; regions: phone -> the same; vertices:
    region -> how many it has.
    """

    settings: Settings
    shapes: TrainingShapes
    region: str
    compactness: Mapping[str, FloatArray] = field(default_factory=dict)
    generalisation: Mapping[str, Curve] = field(default_factory=dict)
    specificity: Mapping[str, Curve] = field(default_factory=dict)
    phones: Mapping[str, Curve] = field(default_factory=dict)
    regions: Mapping[str, str] = field(default_factory=dict)
    vertices: Mapping[str, int] = field(default_factory=dict)


def evaluate(
    shapes: TrainingShapes,
    settings: Settings,
    regions: Mapping[str, Sequence[int]],
    progress: Progress = silent,
) -> Evaluation:
    """Everything that the settings ask for; the same every time.

    regions: name -> vertices; unions that are not among them are made of their parts. Raises InputError for a region that
    is not known and, before anything is measured, where settings and shapes contradict each other.
    """
    known = with_unions(regions) | {WHOLE_MESH: range(shapes.tensor.shape[2] // 3)}
    region = settings.region or (SPEECH if SPEECH in known else WHOLE_MESH)
    if region not in known:
        raise InputError(f"there is no region '{region}' in {shapes.source}; known are {', '.join(known)}.")
    of_phones = {prompt: CRITICAL.get(prompt, region) for prompt in shapes.prompts}
    of_phones = {prompt: name if name in known else region for prompt, name in of_phones.items()}
    _check(shapes, settings, [known[name] for name in {region, *of_phones.values()}])
    common = (settings.samples, settings.seed, settings.jobs, progress)
    wanted = settings.measures
    return Evaluation(
        settings,
        shapes,
        region,
        compactness(shapes) if COMPACTNESS in wanted else {},
        {
            mode: generalisation(shapes, mode, settings.held(mode), settings.h, settings.jobs, progress)
            for mode in MODES
            if GENERALISATION in wanted
        },
        {
            mode: specificity(shapes, mode, settings.held(mode), known[region], *common)
            for mode in MODES
            if SPECIFICITY in wanted
        },
        {
            prompt: phone_specificity(shapes, prompt, settings.pose_modes, known[name], *common)
            for prompt, name in of_phones.items()
            if PHONES in wanted
        },
        of_phones,
        {name: len(known[name]) for name in (region, *of_phones.values())},
    )


def compactness(shapes: TrainingShapes) -> dict[str, FloatArray]:
    """Mode -> (entries,) the cumulative share of the variance."""
    parts = hosvd(shapes.tensor - shapes.tensor.mean(axis=(0, 1)))
    return {
        POSE: cumulative_compactness(parts.pose_spectrum),
        SPEAKER: cumulative_compactness(parts.speaker_spectrum),
    }


def with_unions(regions: Mapping[str, Sequence[int]]) -> dict[str, Sequence[int]]:
    """The regions, and those UNIONS of them that none has the name of."""
    known = dict(regions)
    for name, parts in UNIONS.items():
        if name not in known and all(part in regions for part in parts):
            known[name] = sorted({vertex for part in parts for vertex in regions[part]})
    return known


def _check(shapes: TrainingShapes, settings: Settings, regions: Sequence[Sequence[int]]) -> None:
    for region in regions:
        check_region(shapes, region)
    for what, wanted, entries in zip(
        (SPEAKER, POSE), (settings.speaker_modes, settings.pose_modes), shapes.tensor.shape, strict=False
    ):
        if not 1 <= wanted <= entries:
            raise InputError(
                f"--{what}-modes {wanted}: expected a number from 1 to {entries}, the {what}s of {shapes.source}."
            )
        if entries < 2 and GENERALISATION in settings.measures:
            raise InputError(
                f"{shapes.source}: generalisation leaves one {what} out, and there is no other; ask for "
                "the other measures only."
            )
    if settings.samples < 1:
        raise InputError(f"--samples {settings.samples}: expected 1 or more.")
    if settings.seed < 0:
        raise InputError(f"--seed {settings.seed}: expected 0 or more.")
