"""Which channel of a recording is which coil: roles, and what the field's habits say about names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .. import InputError
from .pose import FloatArray

TONGUE_PREFIX = "tongue_"
LATERAL_ROLES = ("tongue_left", "tongue_right")
# Mid-sagittal tongue roles from tip to root; with fewer coils the middle ones are left out.
TONGUE_ROLES = {
    1: ("tongue_tip",),
    2: ("tongue_tip", "tongue_dorsum"),
    3: ("tongue_tip", "tongue_blade", "tongue_dorsum"),
    4: ("tongue_tip", "tongue_blade", "tongue_dorsum", "tongue_back"),
}
ROLES = (
    "tongue_tip",
    "tongue_blade",
    "tongue_dorsum",
    "tongue_back",
    *LATERAL_ROLES,
    "jaw",
    "upper_lip",
    "lower_lip",
    "mouth_left",
    "mouth_right",
    "head_nose",
    "head_left",
    "head_right",
    "head_upper_incisor",
    "bite_front",
    "bite_left",
    "bite_right",
    "bite_back",
    "palate_probe",
)

# Whole names only, lower case, separators removed. A name that two labs use differently (TB: the body in
# one, the back in another) is only known to be on the tongue; its place is measured, not guessed.
_TIP_NAMES = {"tt", "ttip", "tip", "tonguetip", "t1", "apex"}
_TONGUE_NAMES = {
    *("tb", "td", "tm", "tr", "tmid", "tback", "tbody", "tdorsum", "tblade", "tbl", "troot"),
    *("tongueblade", "tonguebody", "tonguemid", "tonguemiddle", "tonguedorsum", "tongueback", "tonguerear"),
    *("t2", "t3", "t4", "blade", "dorsum"),
}
_LATERAL_NAMES = {
    "tongue_left": {"tongueleft", "tll", "tlat", "tl", "tleft", "tonguelateralleft"},
    "tongue_right": {"tongueright", "tlr", "tright", "tonguelateralright"},
}
_OTHER_NAMES = {
    "jaw": {"jaw", "lowerjaw", "li", "lt", "jw", "lj", "lowerincisor", "mandible", "mni", "jawincisor"},
    "upper_lip": {"ul", "upperlip"},
    "lower_lip": {"ll", "lowerlip"},
    "head_nose": {"nose", "bn", "nasion", "bridge", "refn", "reff"},
    "head_left": {"leftear", "lear", "refl", "lmastoid", "leftmastoid", "lma", "lh"},
    "head_right": {"rightear", "rear", "refr", "rmastoid", "rightmastoid", "rma", "rh"},
    "head_upper_incisor": {"ui", "ut", "upperincisor", "upperjaw"},
}


@dataclass(frozen=True)
class CoilMap:
    """roles: channel -> role, in the order in which the coils are tracked; why: how it came about."""

    roles: Mapping[str, str]
    why: str

    @property
    def tongue(self) -> dict[str, str]:
        """The part that is tracked: channel -> tongue role."""
        return {channel: role for channel, role in self.roles.items() if role.startswith(TONGUE_PREFIX)}


def checked_coil_map(roles: Mapping[str, str], where: str) -> CoilMap:
    """A map that a person wrote: known roles, each once, at least one on the tongue."""
    for channel, role in roles.items():
        if role not in ROLES and not re.fullmatch(r"tongue_[a-z0-9_]+", role):
            raise InputError(
                f"{where}: channel '{channel}' has the role '{role}', which is none of {', '.join(ROLES)}."
            )
    taken: dict[str, str] = {}
    for channel, role in roles.items():
        if role in taken:
            raise InputError(
                f"{where}: the role '{role}' is given to '{taken[role]}' and to '{channel}'; give it once."
            )
        taken[role] = channel
    coil_map = CoilMap(dict(roles), where)
    if not coil_map.tongue:
        raise InputError(
            f"{where}: no channel has a tongue role; give at least one of {', '.join(TONGUE_ROLES[4])} to a channel."
        )
    return coil_map


def guess_coil_map(coils: Sequence[str], positions: FloatArray, source: str) -> CoilMap:
    """Roles from the names that the field uses, and the order along the tongue from the data.

    coils: channel names; positions: (frames, coils, 3) mm in any frame. The coil named as the tip is the
    tip; the other mid-sagittal tongue coils are ordered by their median distance from it, because 'TB'
    and 'TD' are swapped between laboratories. Raises InputError where the names do not tell.
    """
    simple = {name: re.sub(r"[^a-z0-9]", "", name.lower()) for name in coils}
    live = {name for index, name in enumerate(coils) if np.isfinite(positions[:, index]).all(axis=1).any()}
    if {"tl", "tr"} <= {simple[name] for name in live}:  # the two sides; without a left one, TR is the root
        simple = {name: "tongueright" if word == "tr" else word for name, word in simple.items()}
    tips = [name for name in coils if simple[name] in _TIP_NAMES and name in live]
    others = [name for name in coils if simple[name] in _TONGUE_NAMES and name in live]
    if len(tips) != 1 or len(others) > 3:
        with_data = [name for name in coils if name in live] or ["none"]
        raise InputError(
            f"{source}: cannot tell from the names of the channels that have data ({', '.join(with_data)}) which "
            "coils sit on the tongue; "
            "name them with --coils CHANNEL=ROLE,... or in the session's [coils], with the roles "
            f"{', '.join(TONGUE_ROLES[4])}."
        )
    tip = positions[:, list(coils).index(tips[0])]

    def distance_from_tip(name: str) -> float:
        apart = np.linalg.norm(positions[:, list(coils).index(name)] - tip, axis=1)
        return float(np.nanmedian(apart)) if np.isfinite(apart).any() else np.inf

    ordered = tips + sorted(others, key=distance_from_tip)
    roles = dict(zip(ordered, TONGUE_ROLES[len(ordered)], strict=True))
    for role, names in {**_LATERAL_NAMES, **_OTHER_NAMES}.items():
        for name in coils:
            named = simple[name] in names or name == role
            if named and name in live and role not in roles.values():
                roles[name] = role
    return CoilMap(roles, "channel names, ordered by distance from the tip coil")
