"""Speakers outside every training set, phone by phone: what recordings are simulated from.

The surface is known at places that keep to the flesh: a share of the way along the tongue's middle from tip (0) to
vallecula (1), and a share across from -1 (right edge) to 1 (left edge). Head frame, mm, the speaker's true size.
A few speakers lie in model/data/unseen.npz, made by the script beside it; any other is computed.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from .... import InputError
from ....archive import read_arrays
from .anatomy import PALATE_END_MM, ROOF_START_MM, STEP_MM, Anatomy, roof_of
from .articulation import PHONES

FloatArray = NDArray[np.float64]

SEED = 1000  # training sets are made with small ones
SHIPPED = (1, 2, 3)
FILE = ("tonguetrack.model.data", "unseen.npz")
ALONG = np.linspace(0.0, 1.0, 46)
ACROSS = np.array([-0.9, -0.6, -0.3, 0.0, 0.3, 0.6, 0.9])
PALATE_STEP_MM = 1.0
LARGEST_BYTES = 10_000_000


@dataclass(frozen=True)
class UnseenSpeaker:
    """rest_mm: the way from tip to vallecula in the neutral tongue; surfaces: phone -> (ALONG, ACROSS, 3)."""

    number: int
    anatomy: Anatomy
    rest_mm: float
    surfaces: dict[str, FloatArray]

    def at(self, phone: str, behind_tip_mm: float, across: float) -> FloatArray:
        """(3,): where the flesh is that lies that far behind the tip along the middle of the neutral tongue."""
        row = behind_tip_mm / self.rest_mm * (len(ALONG) - 1)
        column = np.interp(across, ACROSS, np.arange(len(ACROSS)))
        i, j = min(int(row), len(ALONG) - 2), min(int(column), len(ACROSS) - 2)
        along, beside = np.array([1.0 - row + i, row - i]), np.array([1.0 - column + j, column - j])
        return np.asarray(np.einsum("i,j,ijk->k", along, beside, self.surfaces[phone][i : i + 2, j : j + 2]))

    def middle(self, phone: str) -> FloatArray:
        """(ALONG, 3): the contour in the mid-sagittal plane."""
        return self.surfaces[phone][:, len(ACROSS) // 2]

    def palate(self) -> FloatArray:
        """(n, 3) on the middle of the hard palate, from the gum behind the incisors to its end."""
        size = self.anatomy.size
        y = np.arange(np.ceil(ROOF_START_MM * size), PALATE_END_MM * size, PALATE_STEP_MM)
        roof = roof_of(self.anatomy)
        z = size * np.interp(y / size / STEP_MM, np.arange(len(roof)), roof)
        return np.column_stack([np.zeros(len(y)), y, z])


def unseen_speaker(number: int, phones: Iterable[str] = PHONES) -> UnseenSpeaker:
    """The speaker of that number, from 0. Those of SHIPPED are read with all phones; of others only these are
    computed, and the neutral one: about half a second each."""
    return _shipped()[number] if number in SHIPPED else computed_speaker(number, phones)


def computed_speaker(number: int, phones: Iterable[str] = PHONES) -> UnseenSpeaker:
    """As `unseen_speaker`, and never from the file."""
    from .making import phantom_speaker

    anatomy = replace(phantom_speaker(SEED, number).anatomy, name=f"Unseen{number:02d}")
    surfaces = {phone: _surface(number, phone)[0] for phone in phones}
    return UnseenSpeaker(number, anatomy, _surface(number, "ə")[1], surfaces)


def unseen_file(speakers: Sequence[UnseenSpeaker]) -> bytes:
    """What `unseen_speaker` reads of speakers with all phones; single precision (10 nm)."""
    words = {
        "phones": PHONES,
        "speakers": [(speaker.number, asdict(speaker.anatomy)) for speaker in speakers],
    }
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        words=np.frombuffer(json.dumps(words, ensure_ascii=False).encode(), dtype=np.uint8),
        rest_mm=np.array([speaker.rest_mm for speaker in speakers]),
        surfaces=np.array(
            [[speaker.surfaces[phone] for phone in PHONES] for speaker in speakers], dtype=np.float32
        ),
    )
    return stream.getvalue()


@cache
def _shipped() -> dict[int, UnseenSpeaker]:
    package, name = FILE
    found = files(package) / name
    if not found.is_file():
        raise InputError(
            f"{name}: this installation has no such file in {package}; install tonguetrack again."
        )
    arrays = read_arrays(found.read_bytes(), LARGEST_BYTES)
    words = json.loads(arrays["words"].tobytes())
    return {
        number: UnseenSpeaker(
            number,
            Anatomy(**anatomy),
            float(rest_mm),
            dict(zip(words["phones"], surfaces.astype(np.float64), strict=True)),
        )
        for (number, anatomy), rest_mm, surfaces in zip(
            words["speakers"], arrays["rest_mm"], arrays["surfaces"], strict=True
        )
    }


@lru_cache(maxsize=32)
def _surface(number: int, phone: str) -> tuple[FloatArray, float]:
    """(ALONG, ACROSS, 3) of a phone, and the way from tip to vallecula, mm."""
    from scipy.interpolate import RegularGridInterpolator

    from .making import phantom_speaker, speakers_tongue

    speaker = phantom_speaker(SEED, number)
    tongue = speakers_tongue(SEED, speaker, phone)
    way = _way(tongue.middle[tongue.tip_row :])
    rows = tongue.tip_row + np.interp(ALONG * way[-1], way, np.arange(len(way)))
    columns = 0.5 * (ACROSS + 1.0) * (tongue.pose.radius.shape[1] - 1)
    all_rows = np.arange(len(tongue.angles))
    width = np.interp(rows, all_rows, tongue.pose.width)
    turned = np.radians(np.interp(rows, all_rows, tongue.angles))[:, None]
    radius = RegularGridInterpolator((all_rows, np.arange(tongue.pose.radius.shape[1])), tongue.pose.radius)(
        np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    )
    surface = np.stack(
        [
            width[:, None] * ACROSS,
            tongue.pose.pole_y - radius * np.cos(turned),
            tongue.pose.pole_z + radius * np.sin(turned),
        ],
        axis=-1,
    )
    return speaker.anatomy.size * surface, speaker.anatomy.size * float(way[-1])


def _way(line: FloatArray) -> FloatArray:
    """(n,) mm from the first point along a line (n, 2)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
