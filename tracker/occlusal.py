"""The occlusal frame: from coils on a bite plate to the model's directions, with the origin at the upper incisors.

A bite plate lies between the teeth for a moment; its coils then show the occlusal plane. Three coils (at the
incisors, left, right), two (at the incisors and, behind in the middle, at the molars) with a lateral direction from
elsewhere, or all four. (Paper, section "Data selection and setup for experiments": bite plane of the subject.)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from .. import InputError
from ..drivers.frames import FrameOfReference
from .pose import FloatArray
from .sagittal import directions, handedness

BITE_ROLES = ("bite_front", "bite_left", "bite_right", "bite_back")

LOOSE_MM = 1.5  # scatter of a distance between coils on one stiff plate; more is no plate
HELD_MM = 3.0  # a frame this near to the plate's usual place counts
HELD_SHARE = 0.5  # of the frames that must count
# Distances that a human mouth and head allow, mm.
BITE_LENGTH_MM = (10.0, 90.0)  # from the incisors to the coils behind, front to back
BITE_WIDTH_MM = (15.0, 90.0)  # left to right
HEAD_DISTANCE_MM = {  # from the incisors to a reference coil
    "head_left": (40.0, 220.0),
    "head_right": (40.0, 220.0),
    "head_nose": (15.0, 160.0),
    "head_upper_incisor": (0.0, 30.0),
}
ASKEW_DEG = 30.0  # left to right against front to back on one plate, from a right angle
AGAINST_AXES_DEG = 50.0  # an occlusal frame turned further against the stated axes contradicts them
SAME_HEAD_MM = 4.0  # reference coils keep their mutual distances within this on one speaker


@dataclass(frozen=True)
class OcclusalFrame:
    """The motion from head-corrected coils to the occlusal frame: occlusal = rotation @ source + translation.

    rotation: (3, 3), orthonormal; with determinant -1 where the source's axes are left-handed. translation: (3,) mm.
    In the occlusal frame x is left, y back, z up, the origin the coil at the upper incisors, the plate z = 0.
    numbers: what a phonetician can judge it by, each with its unit in its name. notes: what was decided, in sentences.
    """

    rotation: FloatArray
    translation: FloatArray
    source: str
    numbers: Mapping[str, float]
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        listed = ", ".join(f"{name.replace('_', ' ')} {value:.1f}" for name, value in self.numbers.items())
        return f"occlusal frame from {self.source} ({handedness(self.rotation)} axes): {listed}"


def occlusal_frame(
    bite: Mapping[str, FloatArray],
    frame: FrameOfReference,
    source: str,
    head: Mapping[str, FloatArray] | None = None,
    left: FloatArray | None = None,
) -> OcclusalFrame:
    """The occlusal frame from a file in which the speaker bites on a plate with coils.

    bite: role -> (frames, 3) mm, head-corrected, NaN = missing; bite_front (at the upper incisors) with bite_left and
    bite_right, or bite_back (behind in the middle), or all. frame: the file's axes, as far as they are known. head:
    role -> (frames, 3) mm of reference coils in the same file; they tell left from right, up from down, and whether
    the plate is in this head at all. left: (3,) roughly the speaker's left, for two coils without left and right ears.

    Up follows from left and back by the handedness of the stated axes, right-handed where they are not stated. It is
    checked with the references. Raises InputError where the coils are on a line, move against each other or lie where
    no teeth are, and where sides, heights or axes contradict each other.
    """
    head = {} if head is None else head
    _check_roles(bite, source)
    loose = _check_stiff(bite, source)
    places, moved = _places(bite, source)
    others = {role: _median_place(path, role, source) for role, path in head.items()}
    front = places["bite_front"]
    _check_mouth(places, others, source)

    notes: list[str] = []
    numbers: dict[str, float] = {}
    back_point = places.get("bite_back")
    if back_point is None:
        back_point = 0.5 * (places["bite_left"] + places["bite_right"])
    back = _unit(back_point - front)
    if "bite_left" in places:
        across = places["bite_left"] - places["bite_right"]
        askew = abs(float(np.rad2deg(np.arcsin(np.clip(_unit(across) @ back, -1.0, 1.0)))))
        if askew > ASKEW_DEG:
            raise InputError(
                f"{source}: bite_left to bite_right runs {askew:.0f} degrees off a right angle to front to back, so one of "
                "the coils of the bite plate has another's role."
            )
        numbers |= {"left_to_right_mm": float(np.linalg.norm(across)), "askew_deg": askew}
    elif {"head_left", "head_right"} <= set(others):
        across = others["head_left"] - others["head_right"]
        notes.append("left and right are those of the head's reference coils")
    elif left is not None:
        across = np.asarray(left, dtype=np.float64)
        notes.append("left and right are as stated, for the bite plate has no coils at its sides")
    else:
        raise InputError(
            f"{source}: {' and '.join(bite)} lie on one line, which does not say how the bite plane is tilted sideways; "
            "add bite_left and bite_right, or the reference coils head_left and head_right."
        )
    sideways = across - (across @ back) * back
    if np.linalg.norm(sideways) < 0.2 * np.linalg.norm(across):
        raise InputError(
            f"{source}: the bite plate's front to back runs along what should be left to right; check the roles."
        )
    sideways = _unit(sideways)
    known = "unknown" not in (frame.x, frame.y, frame.z)
    stated = directions(frame, source) if known else None
    mirrored = stated is not None and np.linalg.det(stated) < 0
    up = np.cross(sideways, back) * (-1.0 if mirrored else 1.0)
    rotation = np.stack([sideways, back, up])
    if stated is None:
        notes.append("the axes of the file are not stated; right-handed ones are assumed")
    else:
        numbers["against_the_stated_axes_deg"] = _check_axes(rotation, stated, frame, source)
    translation = -rotation @ front
    _check_sides(rotation, translation, others, source)

    numbers |= {
        "front_to_back_mm": float(np.linalg.norm(back_point - front)),
        "plate_bends_mm": loose,
        "plate_moves_mm": moved,
    }
    if len(places) == 4:
        middle = 0.5 * (places["bite_left"] + places["bite_right"])
        numbers["fourth_coil_off_the_plane_mm"] = abs(float(up @ (middle - front)))
    return OcclusalFrame(rotation, translation, source, numbers, tuple(notes))


def check_same_head(
    head: Mapping[str, FloatArray], rest_mm: Mapping[str, FloatArray], source: str, rest_source: str
) -> float:
    """The largest difference, mm, between the mutual distances of reference coils in two files.

    head: role -> (frames, 3) mm of one file (`source`); rest_mm: role -> (3,) mm in the other. Distances do not depend on
    axes or origin. Raises InputError where one differs by more than coils on one speaker's head can.
    """
    largest = 0.0
    for first, second in combinations([role for role in head if role in rest_mm], 2):
        here = _usual_distance(head[first], head[second])[0]
        there = float(np.linalg.norm(rest_mm[first] - rest_mm[second]))
        if np.isnan(here):
            continue
        if abs(here - there) > SAME_HEAD_MM:
            raise InputError(
                f"{source}: {first} and {second} are {here:.1f} mm apart, but {there:.1f} mm in {rest_source}; the two "
                "files are of different speakers, or a reference coil was moved between them."
            )
        largest = max(largest, abs(here - there))
    return largest


def _check_roles(bite: Mapping[str, FloatArray], source: str) -> None:
    for role in bite:
        if role not in BITE_ROLES:
            raise InputError(
                f"{source}: '{role}' is no role on a bite plate; there are {', '.join(BITE_ROLES)}."
            )
    sides = {"bite_left", "bite_right"} & set(bite)
    if "bite_front" not in bite or len(sides) == 1 or len(bite) < 2:
        raise InputError(
            f"{source}: a bite plane from {', '.join(bite) or 'no coil'}; needed are bite_front with both bite_left and "
            "bite_right, or with bite_back."
        )


def _check_stiff(bite: Mapping[str, FloatArray], source: str) -> float:
    """The largest scatter of a distance between two coils of the plate, mm."""
    largest = 0.0
    for first, second in combinations(bite, 2):
        usual, scatter = _usual_distance(bite[first], bite[second])
        if np.isnan(usual):
            raise InputError(f"{source}: {first} and {second} are never there in the same frame.")
        if scatter > LOOSE_MM:
            raise InputError(
                f"{source}: {first} and {second} move against each other (their distance of {usual:.1f} mm scatters by "
                f"{scatter:.1f} mm), which coils on one bite plate cannot; check the roles and the file."
            )
        largest = max(largest, scatter)
    return largest


def _places(bite: Mapping[str, FloatArray], source: str) -> tuple[dict[str, FloatArray], float]:
    """Role -> (3,) median place while the plate is held, and the scatter about it then, mm."""
    paths = np.stack(list(bite.values()), axis=1)
    paths = paths[np.isfinite(paths).all(axis=(1, 2))]
    if len(paths) == 0:
        raise InputError(f"{source}: no frame has all of {', '.join(bite)}.")
    middle = np.median(paths, axis=0)
    off = np.linalg.norm(paths - middle, axis=2).mean(axis=1)
    held = off <= HELD_MM
    if held.mean() < HELD_SHARE:
        raise InputError(
            f"{source}: the bite plate stays within {HELD_MM:.0f} mm of one place in only {100 * held.mean():.0f} % of the "
            "frames; it was not held between the teeth, or the head's motion is still in the file."
        )
    places = np.median(paths[held], axis=0)
    return dict(zip(bite, places, strict=True)), float(np.median(off[held]))


def _check_mouth(places: Mapping[str, FloatArray], others: Mapping[str, FloatArray], source: str) -> None:
    front = places["bite_front"]
    if "bite_left" in places:
        left, right = places["bite_left"], places["bite_right"]
        _check_distance("bite_left", "bite_right", left, right, BITE_WIDTH_MM, source)
        across = _unit(left - right)
        to_front = front - 0.5 * (left + right)
        beside = float(np.linalg.norm((front - right) - ((front - right) @ across) * across))
        if beside < BITE_LENGTH_MM[0]:
            raise InputError(
                f"{source}: the coils bite_front, bite_left and bite_right lie on one line (bite_front is {beside:.1f} mm "
                f"off it, expected at least {BITE_LENGTH_MM[0]:.0f}), which is no plane."
            )
        if np.linalg.norm(to_front) > BITE_LENGTH_MM[1]:
            raise InputError(
                f"{source}: bite_front is {np.linalg.norm(to_front):.0f} mm before bite_left and bite_right; in a mouth "
                f"it is at most {BITE_LENGTH_MM[1]:.0f}."
            )
    if "bite_back" in places:
        _check_distance("bite_front", "bite_back", front, places["bite_back"], BITE_LENGTH_MM, source)
    for role, place in others.items():
        if role in HEAD_DISTANCE_MM:
            _check_distance("bite_front", role, front, place, HEAD_DISTANCE_MM[role], source)


def _check_distance(
    first: str, second: str, start: FloatArray, end: FloatArray, allowed: tuple[float, float], source: str
) -> None:
    apart = float(np.linalg.norm(end - start))
    if not allowed[0] <= apart <= allowed[1]:
        raise InputError(
            f"{source}: {first} and {second} are {apart:.1f} mm apart, which in one head is between {allowed[0]:.0f} and "
            f"{allowed[1]:.0f}; check the roles, and that the file is in mm and of this speaker."
        )


def _check_axes(rotation: FloatArray, stated: FloatArray, frame: FrameOfReference, source: str) -> float:
    """The angle, degrees, by which the occlusal frame is turned against the stated axes."""
    cosine = 0.5 * (float(np.trace(rotation @ stated.T)) - 1.0)
    turned = float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))
    if turned > AGAINST_AXES_DEG:
        raise InputError(
            f"{source}: the bite plate is turned {turned:.0f} degrees against the axes of the file ({frame}), more than "
            f"the {AGAINST_AXES_DEG:.0f} of any head; the roles of its coils or the axes are wrong (left and right "
            "exchanged?)."
        )
    return turned


def _check_sides(
    rotation: FloatArray, translation: FloatArray, others: Mapping[str, FloatArray], source: str
) -> None:
    """Whether the head's references are on their sides of the occlusal frame."""
    turned = {role: rotation @ place + translation for role, place in others.items()}
    if {"head_left", "head_right"} <= set(turned):
        across = turned["head_left"] - turned["head_right"]
        if across[0] < 0.7 * np.linalg.norm(across):
            raise InputError(
                f"{source}: the bite plate's left does not agree with head_left and head_right; left and right are "
                "exchanged, on the plate or on the head."
            )
        behind = 0.5 * (turned["head_left"] + turned["head_right"])[1]
        if behind < 0:
            raise InputError(
                f"{source}: head_left and head_right are {-behind:.0f} mm before bite_front; front and back of the bite "
                "plate are exchanged."
            )
    if "head_nose" in turned and turned["head_nose"][2] < 0:
        raise InputError(
            f"{source}: head_nose is {-turned['head_nose'][2]:.0f} mm below the bite plane; either bite_left and "
            "bite_right are exchanged, or the file's axes are left-handed, which it must state then."
        )


def _median_place(path: FloatArray, role: str, source: str) -> FloatArray:
    there = path[np.isfinite(path).all(axis=1)]
    if len(there) == 0:
        raise InputError(f"{source}: {role} has no data in this file; leave it out.")
    return np.asarray(np.median(there, axis=0))


def _usual_distance(first: FloatArray, second: FloatArray) -> tuple[float, float]:
    """Median distance of two coils (frames, 3), mm, and its robust deviation; NaN where they are never both there."""
    apart = np.linalg.norm(first - second, axis=1)
    apart = apart[np.isfinite(apart)]
    if len(apart) == 0:
        return np.nan, np.nan
    usual = float(np.median(apart))
    return usual, 1.4826 * float(np.median(np.abs(apart - usual)))


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))
