"""Our own synthetic speakers: a parametric tongue in a parametric mouth. Plausible, but nobody's anatomy.

Built from general phonetic and anatomical knowledge, in the model frame (mm): x lateral, left positive,
mid-sagittal plane x = 0; y front to back, the upper incisors' edge about the origin; z up.
"""

from .anatomy import Anatomy, random_anatomy, training_anatomies
from .articulation import PHONES, Articulation, Habits, articulation_for, blend, random_habits
from .surface import tongue_surface
from .template import TongueTemplate, tongue_template

__all__ = [
    "PHONES",
    "Anatomy",
    "Articulation",
    "Habits",
    "TongueTemplate",
    "articulation_for",
    "blend",
    "random_anatomy",
    "random_habits",
    "tongue_surface",
    "tongue_template",
    "training_anatomies",
]
