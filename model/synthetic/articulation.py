"""Phones as articulations, and the ways in which speakers differ in producing them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from .anatomy import Anatomy


@dataclass(frozen=True)
class Articulation:
    """Where the muscles put the tongue. Millimetres are those of the reference speaker.

    jaw_deg: rotation about the hinge of the jaw, opening positive; body_front_mm, body_up_mm: the whole
    body; arch_mm at arch_place (0 blade .. 1 back): a hump of the dorsum; root_front_mm: root advanced;
    tip_front_mm, tip_up_mm: the tip; blade_up_mm: the part behind it; groove_mm at groove_place: depth of
    the midline groove; brace_mm: sides pressed up against palate and teeth; flat: 0 round .. 1 flat across;
    tilt_mm: left side up, right side down.
    """

    jaw_deg: float = 0.0
    body_front_mm: float = 0.0
    body_up_mm: float = 0.0
    arch_mm: float = 0.0
    arch_place: float = 0.5
    root_front_mm: float = 0.0
    tip_front_mm: float = 0.0
    tip_up_mm: float = 0.0
    blade_up_mm: float = 0.0
    groove_mm: float = 0.6
    groove_place: float = 0.3
    brace_mm: float = 0.0
    flat: float = 0.0
    tilt_mm: float = 0.0


@dataclass(frozen=True)
class Habits:
    """How one speaker speaks. jaw: share of opening done by the jaw (1 = as the table); reach: how far
    targets are reached; arch_shift: humps further back; laminal: 0 apical .. 1 laminal sibilants;
    bunching: raised back in u-like vowels rather than the whole body; root: use of the root;
    fronting_mm: rounded back vowels said further front; retraction_mm: tip and floor withdrawn with the
    body in back vowels; doming_mm: the body raised behind the sibilants' constriction;
    posture_front_mm, posture_up_mm: where the body rests in every phone; scatter: seed of the speaker's own
    deviation in each phone; tilt_mm: a habitual tilt."""

    jaw: float = 1.0
    reach: float = 1.0
    arch_shift: float = 0.0
    laminal: float = 0.5
    bunching: float = 0.5
    root: float = 1.0
    fronting_mm: float = 0.0
    retraction_mm: float = 0.0
    doming_mm: float = 0.0
    posture_front_mm: float = 0.0
    posture_up_mm: float = 0.0
    scatter: int = 0
    tilt_mm: float = 0.0


# Sustained phones; the vowels by height and place, the sibilants by constriction.
PHONES: Mapping[str, Articulation] = {
    "i": Articulation(1.5, 5.0, 3.2, 4.2, 0.34, 8.0, 0.5, 1.5, 2.0, 0.9, 0.75, 5.5, 0.25),
    "e": Articulation(3.5, 4.0, 2.2, 3.0, 0.36, 5.5, 0.5, 1.0, 1.5, 0.8, 0.7, 5.0, 0.2),
    "ɛ": Articulation(6.0, 3.0, 1.5, 2.0, 0.40, 3.0, 1.0, 1.0, 1.0, 0.7, 0.6, 1.5, 0.15),
    "a": Articulation(9.0, 1.0, -1.0, 0.0, 0.50, -1.0, 1.0, -1.0, -0.5, 0.7, 0.5, 0.0, 0.2),
    "ɑ": Articulation(9.0, -6.5, -3.0, 1.0, 0.85, -7.0, -4.0, -2.0, -1.5, 0.6, 0.5, -0.5, 0.1),
    "ʌ": Articulation(7.0, -2.5, -1.5, 0.5, 0.65, -3.0, -1.5, -1.0, -0.5, 0.6, 0.5, 0.0, 0.1),
    "ɔ": Articulation(7.0, -7.0, -0.5, 2.5, 0.82, -5.0, -6.0, -2.0, -1.5, 0.5, 0.4, 0.0, 0.0),
    "o": Articulation(4.5, -6.0, 2.0, 4.5, 0.76, -2.5, -6.0, -1.0, -1.0, 0.5, 0.4, 1.0, 0.0),
    "u": Articulation(2.5, -4.0, 3.5, 6.0, 0.70, 2.5, -6.0, 0.0, 0.5, 0.5, 0.8, 2.5, 0.0),
    "ʉ": Articulation(2.0, 1.5, 2.8, 4.6, 0.50, 6.0, -2.0, 1.5, 2.0, 0.7, 0.7, 3.5, 0.1),
    "ə": Articulation(4.0, 0.0, 0.0, 0.5, 0.50, 0.0, 0.0, 0.0, 0.0, 0.6, 0.5, 0.5, 0.1),
    "s": Articulation(1.0, 1.5, 0.5, -1.5, 0.50, 1.5, 1.0, 5.0, 4.0, 3.8, 0.18, 8.0, 0.45),
    "ʃ": Articulation(1.5, -1.0, 2.5, 2.5, 0.34, 3.0, -3.5, 6.0, 6.0, 3.8, 0.26, 6.5, 0.35),
}
SIBILANTS = ("s", "ʃ")
# Share of posture and scatter: a narrow channel leaves a speaker little freedom, a schwa is near rest.
FREEDOM = {"s": 0.4, "ʃ": 0.4, "ə": 0.5}
# Standard deviations of a speaker's own way with one phone.
SCATTER = Articulation(1.3, 2.0, 1.3, 1.3, 0.06, 2.4, 1.6, 1.5, 0.9, 0.2, 0.03, 0.6, 0.07, 0.2)


def random_habits(seed: int) -> Habits:
    """The habits of speaker `seed`; the same seed gives the same habits."""
    random = np.random.default_rng([seed, 23])
    return Habits(
        jaw=float(np.clip(random.normal(1.0, 0.30), 0.45, 1.6)),
        reach=float(np.clip(random.normal(1.05, 0.16), 0.75, 1.4)),
        arch_shift=float(np.clip(random.normal(0.0, 0.04), -0.08, 0.08)),
        laminal=float(random.uniform(0.0, 1.0)),
        bunching=float(random.uniform(0.0, 1.0)),
        root=float(np.clip(random.normal(1.0, 0.30), 0.5, 1.6)),
        fronting_mm=float(np.clip(random.normal(0.0, 3.2), -4.0, 6.0)),
        retraction_mm=float(np.clip(random.normal(1.5, 3.0), -3.0, 7.0)),
        doming_mm=float(np.clip(random.normal(0.0, 2.5), -3.5, 3.5)),
        posture_front_mm=float(np.clip(random.normal(0.0, 2.8), -4.5, 4.0)),
        posture_up_mm=float(np.clip(random.normal(-0.5, 1.2), -2.5, 2.0)),
        scatter=seed,
        tilt_mm=float(random.normal(0.0, 0.4)),
    )


def articulation_for(anatomy: Anatomy, phone: str, habits: Habits) -> Articulation:
    """How this speaker produces this phone.

    Opening that the jaw does not do is done by lowering the tongue, and the other way round; a high palate
    is reached by more arching; sibilants are apical or laminal; back vowels bunched or moved as a whole.
    """
    target = PHONES[phone]
    values = {field.name: getattr(target, field.name) for field in fields(Articulation)}
    opening = values["jaw_deg"] - PHONES["ə"].jaw_deg
    values["jaw_deg"] = PHONES["ə"].jaw_deg + opening * habits.jaw
    values["body_up_mm"] += 0.55 * opening * (habits.jaw - 1.0)
    for name in ("body_front_mm", "body_up_mm", "arch_mm", "tip_front_mm"):
        values[name] *= habits.reach
    values["root_front_mm"] *= habits.root * habits.reach
    freedom = FREEDOM.get(phone, 1.0)
    values["body_front_mm"] += freedom * habits.posture_front_mm
    values["body_up_mm"] += freedom * habits.posture_up_mm
    high = anatomy.palate_height_mm - 15.0
    if values["arch_mm"] > 1.0:
        values["arch_mm"] += 0.45 * high
        values["body_up_mm"] += 0.15 * high
        values["arch_place"] += habits.arch_shift
    if phone in SIBILANTS:
        values["brace_mm"] += 0.5 * max(high, 0.0)
        apical = 1.0 - 2.0 * habits.laminal  # +1 apical .. -1 laminal
        values["tip_up_mm"] += 1.2 * apical
        values["blade_up_mm"] -= 1.2 * apical
        values["tip_front_mm"] += 0.8 * apical
        values["groove_mm"] += 0.5 * apical
        values["body_up_mm"] += habits.doming_mm
        values["body_front_mm"] += 0.5 * habits.doming_mm
    if phone in ("u", "o", "ɔ", "ʉ"):
        bunched = habits.bunching - 0.5
        values["arch_mm"] += 3.0 * bunched
        values["body_front_mm"] += 3.0 * bunched
        values["body_up_mm"] -= 2.0 * bunched
        values["body_front_mm"] += habits.fronting_mm
        values["root_front_mm"] += 0.7 * habits.fronting_mm
        values["tip_front_mm"] += 0.5 * habits.fronting_mm
    if phone in ("ɑ", "ɔ", "o", "u", "ʌ"):
        values["tip_front_mm"] -= habits.retraction_mm
        values["body_front_mm"] -= 0.4 * habits.retraction_mm
    values["tilt_mm"] += habits.tilt_mm
    random = np.random.default_rng([habits.scatter, 37, *phone.encode()])
    for field in fields(Articulation):
        drawn = float(np.clip(random.normal(), -1.7, 1.7))
        values[field.name] += freedom * getattr(SCATTER, field.name) * drawn
    values["body_front_mm"] = min(values["body_front_mm"], 7.5)  # in front of it are the teeth
    values["groove_mm"] = max(values["groove_mm"], 0.2)
    values["flat"] = min(max(values["flat"], 0.0), 0.8)
    values["arch_place"] = min(max(values["arch_place"], 0.1), 0.95)
    return Articulation(**values)


def blend(first: Articulation, second: Articulation, t: float) -> Articulation:
    """The articulation at share t of the way from the first to the second."""
    return Articulation(
        *(
            (1.0 - t) * getattr(first, field.name) + t * getattr(second, field.name)
            for field in fields(Articulation)
        )
    )
