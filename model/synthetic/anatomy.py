"""Speakers: the sizes of their mouths and tongues, and the palate above them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Anatomy:
    """One speaker. Ratios are to the reference speaker, an adult of middle size.

    size: everything; mouth: length of the oral part; pharynx: height of the pharyngeal part;
    width: of the tongue; thickness: of its body, floor to dorsum; blade: length of the free tip;
    palate_height_mm: highest point of the palate above the incisors' edge; palate_apex_mm: its distance
    behind them; palate_doming: exponent of the vault across (2 parabola, more = flatter roof, steeper sides);
    arch_mm: half width of the dental arch; wall_mm: the pharyngeal wall's distance behind the incisors.
    """

    name: str
    size: float = 1.0
    mouth: float = 1.0
    pharynx: float = 1.0
    width: float = 1.0
    thickness: float = 1.0
    blade: float = 1.0
    palate_height_mm: float = 15.0
    palate_apex_mm: float = 31.0
    palate_doming: float = 2.4
    arch_mm: float = 23.5
    wall_mm: float = 84.0

    def arch_half_width(self, y: FloatArray) -> FloatArray:
        """Half width of the dental arch, mm, at a distance y behind the incisors."""
        opening = _smooth_step((y + 4.0) / (26.0 * self.size * self.mouth))
        return np.asarray(self.arch_mm * self.size * (0.45 + 0.55 * opening))

    @property
    def hard_palate_mm(self) -> float:
        """How far behind the incisors the bone ends and the soft palate, which moves, takes over."""
        return 50.0 * self.size * self.mouth

    def palate_z(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height of the palate above a place (x, y), mm: ridge, vault, soft palate; beside the
        arch it stays at the height of its edge."""
        along = self.size * self.mouth
        ridge = 7.0 * along
        apex = self.palate_apex_mm * along
        end = 62.0 * along
        top = self.palate_height_mm * self.size
        edge = -3.0 * self.size
        rise = _smooth_step((y + 2.0) / (ridge + 2.0)) * 0.42 + _smooth_step((y - 2.0) / (apex - 2.0)) * 0.58
        fall = _smooth_step((y - apex - 6.0 * along) / (end - apex - 6.0 * along))
        middle = edge + (top - edge) * rise - fall * (top - 5.0 * self.size)
        across = np.minimum(np.abs(x) / self.arch_half_width(y), 1.0)
        return np.asarray(middle - (middle - edge) * across**self.palate_doming)


def training_anatomies() -> tuple[Anatomy, ...]:
    """The eleven speakers of the sample database: seven smaller, four larger, no two alike."""
    rows = (
        # size mouth pharynx width thick blade palate apex dome arch wall
        (0.97, 1.02, 0.92, 0.98, 1.00, 1.00, 14.0, 30.0, 2.3, 23.0, 83.0),
        (0.93, 0.95, 0.95, 1.04, 1.05, 0.90, 16.5, 28.0, 2.0, 22.5, 82.0),
        (1.00, 1.00, 1.00, 1.00, 0.97, 1.05, 13.0, 32.0, 2.8, 24.0, 84.0),
        (0.91, 0.97, 0.90, 1.03, 1.00, 1.10, 15.0, 31.0, 2.5, 22.0, 83.0),
        (0.95, 1.05, 0.96, 0.97, 0.94, 1.00, 12.0, 33.0, 3.0, 23.5, 85.0),
        (0.98, 0.98, 1.02, 1.06, 1.03, 0.95, 17.5, 29.0, 2.1, 24.0, 84.0),
        (0.94, 1.00, 0.94, 1.02, 1.02, 1.05, 15.5, 30.0, 2.2, 23.0, 83.0),
        (1.06, 1.03, 1.10, 1.00, 1.02, 1.00, 16.0, 32.0, 2.4, 24.5, 86.0),
        (1.09, 0.99, 1.16, 1.03, 1.06, 0.92, 14.5, 30.0, 2.6, 24.0, 84.0),
        (1.04, 1.07, 1.08, 0.94, 0.95, 1.12, 18.0, 34.0, 2.1, 23.0, 87.0),
        (1.11, 1.01, 1.13, 1.05, 1.00, 1.02, 15.0, 31.0, 2.7, 25.0, 85.0),
    )
    return tuple(Anatomy(f"Speaker{number:02d}", *row) for number, row in enumerate(rows, start=1))


def random_anatomy(seed: int) -> Anatomy:
    """A speaker outside the training set, inside the same population."""
    random = np.random.default_rng([seed, 11])
    middle = (1.00, 1.00, 1.01, 1.00, 1.00, 1.01, 15.2, 31.0, 2.4, 23.5, 84.2)
    spread = (0.05, 0.03, 0.06, 0.03, 0.03, 0.05, 1.5, 1.3, 0.25, 0.7, 1.0)
    drawn = np.asarray(middle) + np.asarray(spread) * np.clip(random.normal(size=len(middle)), -1.8, 1.8)
    return Anatomy(f"Unseen{seed:02d}", *(round(float(value), 3) for value in drawn))


def _smooth_step(t: FloatArray) -> FloatArray:
    t = np.clip(t, 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))
