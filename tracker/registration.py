"""The rigid motion that brings a speaker's coils into the model's frame, found with the model itself.

Paper, section "Data selection and setup for experiments": "we used the palate shape and the bite plane of the
subject to rigidly align the data to our tongue model in a semi-supervised way". Here: a first guess, from a bite
plane or from axes alone, says how far it may be wrong; the tracking residuals over frames spread through the
recording say the rest, and the palate is an upper bound.

Residuals alone cannot do it: a model with free weights follows coils that are 35 mm away, or turned by 40 degrees,
about as closely as it follows the right ones. What tells a good place from a bad one is how unusual a speaker and
how unusual poses it takes. So this is minimised, the negative logarithm of a posterior:

    J(motion, vertices, s) =
          P * mean over frames of -log Normal(motion(q_t); v(s, p_mean), noise^2 I + D(s) Sigma_p D(s)')
        + (N - P) * mean over frames of -log Normal(what of motion(q_t) - v(s, p_mean) no pose can follow; 0, noise^2 I)
        + |s - s_mean|^2 / (2 sigma_s^2)
        + |motion - guess|^2 / (2 sd^2)
        + (place of the tip coil - usual)^2 / (2 sd^2)    mm along the contour: coils can slide, and the motion with them
        + (height above the palate)^2 / (2 sd^2)          mean of the worst twentieth of the frames

The poses are integrated out: D(s) = d v / d p at the coils, sigma_s and Sigma_p as measured on the model's training
weights. (With the best pose instead, a larger speaker who moves less would win, however exact the coils.) The frames
enter by their mean and covariance alone, which is why this is fast. What parts coils and vertices is mostly what the
model cannot express, and that is the same in every frame: T frames say no more than N = T / (1 + (T - 1) r)
independent ones, where r is the share of the noise that is not the device's own, and T is as many as the residuals'
autocorrelation leaves (smoothing, and what is left of the head's motion, make neighbours alike). How usual the poses are is told by
fewer still, P, for neighbouring frames show the same pose: reckoned alike, from as many frames as their
autocorrelation leaves. The noise is estimated from the residuals, so coils that the model can express place themselves
to a fraction of a millimetre, and those of a stranger stay near their bite plane. Scale is not fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from .. import InputError
from ..model.midsagittal import midsagittal_vertices, upper_surface_vertices
from ..model.multilinear import Mode, TongueModel
from .alignmentterms import FrameTerms, Term, mean_frame, motion_about, palate_bound
from .anatomy import SpeakerEstimator
from .coilmap import LATERAL_ROLES, TONGUE_ROLES
from .correspondences import Correspondences, Places, complete_frames, slid_along_contour
from .palate import Palate
from .pose import FloatArray
from .session import Energy
from .speakers import effective_frames

SHOWN_FRAMES = 120  # spread through the recording: for the palate, and for the speaker that is told
MOST_INDEPENDENT = 1000  # frames; a recording has more only on paper
# Where coils usually sit: mm behind the front end of the contour. Only the tip's place is believed, within its sd.
USUAL_PLACES_MM = dict(zip(TONGUE_ROLES[4], (10.0, 27.0, 45.0, 58.0), strict=True))
TIP_PLACE_SD_MM = 4.0
ASIDE_SD_MM = 1.0  # of the vertex of a mid-sagittal coil from the plane
STARTS_MM = (-4.0, 0.0, 4.0)  # along the contour, from the usual place
LANDMARK_SD_MM = 6.0  # how far the mean tongue's landmarks are from a speaker's own
MODEL_NOISE_MM = 1.0  # what parts a real speaker and the model at the coils; the most that is believed
DEVICE_NOISE_MM = 0.3  # of a coordinate; what is less does not repeat from frame to frame
NOISES_MM = np.geomspace(0.1, MODEL_NOISE_MM, 25)
OUTLIER_MEDIANS = 6.0
PALATE_SD_MM = 0.25
WORST_SHARE = 0.05  # of the frames, for the palate's bound
PALATE_STRIDE = 3  # of the shown frames, while the motion is sought
ROUGH_ROUNDS, ROUNDS = 2, 15
FINISHED_ENDS = 2
LATERAL_TRIALS = 12  # vertices around a lateral coil
ADAPTATIONS = 4  # between two slides along the contour
COOLING = 0.6  # by which the noise may fall between two slides: with less noise, places are harder to leave
FULL_STEPS, TRIAL_STEPS = 60, 12  # of a descent; of one that only compares places
UNITS = (2.0, 0.05)  # mm and radians of one step of the search
CURVATURE_STEP = 0.02  # in units of the search: less than the kinks of the palate, more than rounding
FAR_FROM_GUESS = 2.5  # standard deviations
CONTRADICTION = 3.0  # standard deviations from the guess; a fit farther away is not believed to be sure
# How noise is shared between coils (what is left of the head's motion is in all of them) is known no better than from
# so many frames, though J takes it for independent; for how sure the motion is.
SURE_FRAMES = 50


@dataclass(frozen=True)
class FirstGuess:
    """Where the coils are believed to be: model = rotation @ coil + translation.

    rotation: (3, 3); translation_mm: (3,); translation_sd_mm, rotation_sd_deg: how far it may be wrong, per axis, at
    the tongue (a bite plane: about 3 mm and 4 degrees; axes alone: tens of mm). source: for people.
    """

    rotation: FloatArray
    translation_mm: FloatArray
    translation_sd_mm: float
    rotation_sd_deg: float
    source: str

    def __post_init__(self) -> None:
        if not np.allclose(self.rotation @ self.rotation.T, np.eye(3), atol=1e-6):
            raise InputError(f"{self.source}: the first guess's rotation is not orthonormal.")
        if not (self.translation_sd_mm > 0 and self.rotation_sd_deg > 0):
            raise InputError(
                f"{self.source}: a first guess may be wrong by {self.translation_sd_mm:g} mm and "
                f"{self.rotation_sd_deg:g} degrees; both need to be above 0."
            )


@dataclass(frozen=True)
class Registration:
    """A rigid alignment with what it rests on.

    rotation (3, 3), translation_mm (3,): model = rotation @ coil + translation, of the coils as they were given.
    correspondences: roles, vertices and mean distances, in the coils' order.
    speaker_weights: (m,) raw, the joint estimate over the sampled frames with the tracker's energy.
    residual_before_mm, residual_mm: mean distance of coils from vertices for that estimate, at the first guess and
    now, with the same vertices. sure: (3,) for mid-sagittal coils: sd of y, z in mm and of the pitch in degrees; else
    (6,): of x, y, z in mm and of the rotations about x, y, z in degrees; from the curvature of J with N at most
    SURE_FRAMES, and no less than its contradiction of the guess asks for.
    posterior: J. noise_mm: what it took for the model's misfit. palate_margin_mm: by how much the contour is above
    the palate in the highest 1 % of the sampled frames (negative: below); NaN without a palate.
    sentences: for people.
    """

    rotation: FloatArray
    translation_mm: FloatArray
    correspondences: Correspondences
    speaker_weights: FloatArray
    residual_before_mm: float
    residual_mm: float
    sure: FloatArray
    posterior: float
    noise_mm: float
    palate_margin_mm: float
    sentences: tuple[str, ...]

    @property
    def vertices(self) -> tuple[int, ...]:
        return self.correspondences.vertices


@dataclass(frozen=True)
class Handedness:
    """How the coils fit as they are, and with axes turned round: J and residual in mm for each.

    turned: "as it is", "front and back exchanged", "up and down exchanged", "both exchanged"; the middle two are
    mirror images, the last is half a turn. Nothing is applied.
    """

    turned: tuple[str, ...]
    posteriors: tuple[float, ...]
    residuals_mm: tuple[float, ...]

    @property
    def best(self) -> str:
        return self.turned[int(np.argmin(self.posteriors))]

    @property
    def mirrored(self) -> bool:
        return int(np.argmin(self.posteriors)) in (1, 2)

    def __str__(self) -> str:
        each = ", ".join(
            f"{name} {residual:.2f} mm (cost {cost:.0f})"
            for name, residual, cost in zip(self.turned, self.residuals_mm, self.posteriors, strict=True)
        )
        if self.best == self.turned[0]:
            return f"the coils fit best as they are: {each}"
        kind = "a mirror image" if self.mirrored else "half a turn"
        return f"the coils would fit better with {self.best}, {kind}; check the axes: {each}"


# Names as in `Handedness.turned`: signs of y and z.
_TURNS = {
    "as it is": (1.0, 1.0),
    "front and back exchanged": (-1.0, 1.0),
    "up and down exchanged": (1.0, -1.0),
    "both exchanged": (-1.0, -1.0),
}


def fit_alignment(
    model: TongueModel,
    coils: FloatArray,
    roles: Sequence[str],
    guess: FirstGuess,
    energy: Energy,
    palate: Palate | None = None,
    midsagittal: bool = True,
) -> Registration:
    """The rigid motion, the correspondences and the speaker that explain the coils together.

    coils: (frames, n, 3) mm, smoothed and head-corrected, NaN = missing; roles: (n,); palate: in the coils' frame,
    whose axes have the model's directions up to the guess. midsagittal: the motion stays in the mid-sagittal plane
    (y, z, pitch) and x is set to 0 afterwards, as the paper does; False: all six parameters. Mid-sagittal coils keep
    the order of their roles along the contour. Deterministic.

    Raises InputError where no frame has all coils, or the model too few vertices for them.
    """
    frames = np.asarray(coils[complete_frames(coils)], dtype=np.float64)
    posterior, found = _settled(lambda: _Posterior(model, frames, roles, guess, palate, midsagittal))
    sure = _believable(
        posterior.standard_deviations(found),
        posterior.guess_deviations(),
        posterior.deviations_from_guess(found.unknowns),
    )

    vertices = tuple(int(posterior.candidates[place]) for place in found.places)
    at_coils = model.at(vertices)
    placed = posterior.moved(found.unknowns)
    estimator = SpeakerEstimator(at_coils, energy, len(placed))
    before = estimator.estimate(posterior.moved(np.zeros(len(found.unknowns))), None, True)
    speaker = estimator.estimate(placed, None, True)
    assert before is not None and speaker is not None
    distances = np.linalg.norm(_shapes(at_coils, speaker.weights, estimator.poses) - placed, axis=2)
    correspondences = Correspondences(
        tuple(roles), vertices, tuple(float(one) for one in distances.mean(axis=0))
    )
    rotation, translation = posterior.whole_motion(found.unknowns)
    margin = np.nan
    if palate is not None:
        contour = model.at([int(vertex) for vertex in midsagittal_vertices(model)])
        contours = _shapes(contour, speaker.weights, estimator.poses)
        margin = float(np.quantile(posterior.heights(contours, found.unknowns), 0.99))
    registration = Registration(
        rotation, translation, correspondences, speaker.weights, before.residual_mm, speaker.residual_mm, sure,
        found.value, posterior.noise_mm, margin, (),
    )  # fmt: skip
    return replace(registration, sentences=_sentences(registration, posterior, found.unknowns, guess))


def handedness(
    model: TongueModel,
    coils: FloatArray,
    roles: Sequence[str],
    guess: FirstGuess,
    energy: Energy,
) -> Handedness:
    """Whether mid-sagittal coils (frames, n, 3) mm are mirrored or upside down: a registration of each possibility.

    A tongue is rounded upwards and its tip is in front, so the coils tell, as long as they are not in one line. What
    they cannot tell is left from right. For the caller to show; nothing is applied.
    """
    frames = coils[complete_frames(coils)] @ guess.rotation.T + guess.translation_mm
    centre = np.median(frames, axis=(0, 1))
    here = replace(guess, rotation=np.eye(3), translation_mm=np.zeros(3))
    costs, residuals = [], []
    for signs in _TURNS.values():
        turned = (frames - centre) * [1.0, *signs] + centre
        posterior = _Posterior(model, turned, roles, here, None, True)
        found = _rough_ends(posterior)[0]
        placed = posterior.moved(found.unknowns)
        vertices = [int(posterior.candidates[place]) for place in found.places]
        estimate = SpeakerEstimator(model.at(vertices), energy, len(placed)).estimate(placed, None, True)
        assert estimate is not None
        costs.append(found.value)
        residuals.append(estimate.residual_mm)
    return Handedness(tuple(_TURNS), tuple(costs), tuple(residuals))


def _rough_ends(posterior: _Posterior) -> list[_Found]:
    """The ends from all starts with the first noise, the best one first, each set of places once."""
    ends = [
        posterior.settle(posterior.begin(places), places, ROUGH_ROUNDS, adaptive=False)
        for places in posterior.first_places()
    ]
    ends.sort(key=lambda end: end.value)
    return [end for index, end in enumerate(ends) if end.places not in [one.places for one in ends[:index]]]


def _settled(posterior: Callable[[], _Posterior]) -> tuple[_Posterior, _Found]:
    """The best of the ends that are reached from the best rough ones, with the posterior as it was left there."""
    settled = []
    for rough in _rough_ends(posterior())[:FINISHED_ENDS]:
        own = posterior()
        settled.append((own, own.settle(rough.unknowns, rough.places, ROUNDS, adaptive=True)))
    noise = max(own.noise_mm for own, _ in settled)  # J is only comparable with the same noise
    return min(settled, key=lambda one: one[0].value(one[1].unknowns, one[1].places, noise))


@dataclass(frozen=True)
class _Found:
    """An end of the search. unknowns: motion, then the speaker in measured sigma; value: J there."""

    unknowns: FloatArray
    places: Places
    value: float


class _Posterior:
    """J of the module's docstring as a function of motion, speaker and the places of the coils.

    A motion is (y, z, pitch) or (x, y, z, rotation vector), mm and radians, about the middle of the coils as the
    guess has them. A place is an index into `candidates`: the contour's vertices from tip to root, then, for lateral
    coils, those of the upper surface.
    """

    def __init__(
        self,
        model: TongueModel,
        frames: FloatArray,
        roles: Sequence[str],
        guess: FirstGuess,
        palate: Palate | None,
        midsagittal: bool,
    ) -> None:
        self._guess = guess
        self._palate = palate
        self._midsagittal = midsagittal
        self._coils = frames @ guess.rotation.T + guess.translation_mm
        self._centre = np.median(self._coils, axis=(0, 1))
        self._roles = tuple(roles)
        self._lateral = [index for index, role in enumerate(roles) if role in LATERAL_ROLES]
        self._middle = [index for index in range(len(roles)) if index not in self._lateral]
        if all(roles[index] in TONGUE_ROLES[4] for index in self._middle):
            self._middle.sort(key=lambda index: TONGUE_ROLES[4].index(roles[index]))
        contour = midsagittal_vertices(model)
        if len(contour) < len(self._middle):
            raise InputError(
                f"the model '{model.name}' has {len(contour)} vertices of its upper surface near the plane x = 0, too "
                f"few for {len(self._middle)} coils."
            )
        self._contour_size = len(contour)
        surface = upper_surface_vertices(model) if self._lateral else np.zeros(0, dtype=np.intp)
        self.candidates: NDArray[np.intp] = np.concatenate([contour, surface])
        self._model = model.at([int(vertex) for vertex in self.candidates])
        along = self._model.at(range(len(contour)))
        self._contour_arrays = np.array(along.core), np.array(along.origin)
        self._surface = self._model.at(range(len(contour), len(self.candidates)))
        self._mean = self._model.mean_vertices()
        steps = np.linalg.norm(np.diff(self._mean[: len(contour), 1:], axis=0), axis=1)
        self._along = np.concatenate([[0.0], np.cumsum(steps)])
        self._speaker_sd, pose_sd = (_measured_sigma(mode) for mode in (model.speaker, model.pose))
        # Copies: read-only arrays are another type for the compiler.
        self._training_poses = model.pose.mean.copy(), np.diag(pose_sd**2)
        self._pose_mean, self._pose_covariance = self._training_poses
        self.size = 3 if midsagittal else 6
        self._shifts = 2 if midsagittal else 3  # the rest of the motion turns
        turns = self.size - self._shifts
        self._units = np.array([UNITS[0]] * self._shifts + [UNITS[1]] * turns + [1.0] * model.speaker.size)
        self._sd = np.array(
            [guess.translation_sd_mm] * self._shifts + [np.radians(guess.rotation_sd_deg)] * turns
        )
        if palate is not None:
            back_and_up = palate.directions @ guess.rotation.T
            places_mm = np.array(palate.curve) + (back_and_up @ guess.translation_mm)[:, None]
            self._palate_arrays = back_and_up, places_mm
        # The axes that are measured: across the plane, projected coils say nothing.
        self._axes = np.flatnonzero(np.tile([not midsagittal, True, True], len(roles))).astype(np.int64)
        self.noise_mm = MODEL_NOISE_MM
        self._at_places: dict[Places, tuple[FloatArray, FloatArray]] = {}
        self._poses_seen = _poses_seen(self._coils.reshape(len(self._coils), -1)[:, self._axes])
        self._residuals_seen = float(len(self._coils))
        self._summarise(_near_their_medians(self._coils))

    def _summarise(self, kept: NDArray[np.bool_]) -> None:
        """The frames that count, as their mean (3n,) and covariance (3n, 3n), and some of them for the palate."""
        flat = self._coils[kept].reshape(int(kept.sum()), -1)
        self._middle_of_frames = flat.mean(axis=0)
        self._spread = np.cov(flat.T, bias=True) if len(flat) > 1 else np.zeros((flat.shape[1],) * 2)
        self.shown = _evenly(flat.reshape(len(flat), -1, 3), SHOWN_FRAMES)
        self._under_palate = np.array(self.shown[::PALATE_STRIDE].reshape(-1, flat.shape[1]), order="C")

    # Where to begin ---------------------------------------------------------------------------------

    def first_places(self) -> list[Places]:
        """Landmarks: the coils as far apart along the mean contour as they are in the data, from several places of
        the first."""
        gaps = np.linalg.norm(np.diff(self._coils[:, self._middle], axis=1), axis=2)
        apart = np.concatenate([[0.0], np.cumsum(np.median(gaps, axis=0))])
        aside = np.abs(self._mean[: self._contour_size, 0])
        usual = USUAL_PLACES_MM["tongue_tip"]
        if self._middle:
            usual = USUAL_PLACES_MM.get(self._roles[self._middle[0]], usual)
        found = []
        for start in STARTS_MM:
            places = np.zeros(len(self._roles), dtype=np.intp)
            least = 0
            for order, index in enumerate(self._middle):
                miss = np.abs(self._along - (usual + start + apart[order])) + aside
                most = self._contour_size - (len(self._middle) - order)
                places[index] = least + int(np.argmin(miss[least : most + 1]))
                least = int(places[index]) + 1
            for index in self._lateral:
                surface = self._mean[self._contour_size :]
                coil = np.median(self._coils[:, index], axis=0)
                same_side = surface[:, 0] * (coil[0] - self._centre[0]) > 0
                away = np.linalg.norm(surface - coil, axis=1)
                places[index] = self._contour_size + int(np.argmin(np.where(same_side, away, np.inf)))
            found.append(tuple(int(place) for place in places))
        return found

    def begin(self, places: Places) -> FloatArray:
        """The mean speaker, moved from the coils' middle to that of their landmarks, as far as the guess may be
        wrong."""
        share = self._guess.translation_sd_mm**2 / (self._guess.translation_sd_mm**2 + LANDMARK_SD_MM**2)
        shift = share * (self._mean[list(places)] - np.median(self._coils, axis=0)).mean(axis=0)
        unknowns = np.zeros(len(self._units))
        unknowns[: self._shifts] = shift[-self._shifts :]
        return unknowns

    # The motion -------------------------------------------------------------------------------------

    def _rigid(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotation and translation from the guess's frame to the model's."""
        motion = self._motion_and_slopes(unknowns)[0]
        return motion[:3], motion[3]

    def _motion_and_slopes(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Of `motion_about`, for these unknowns."""
        turn, shift = np.zeros(3), np.zeros(3)
        turn[: self.size - self._shifts] = unknowns[self._shifts : self.size]
        shift[-self._shifts :] = unknowns[: self._shifts]
        motion, slopes = motion_about(self._centre, shift, turn)
        return motion, slopes

    def whole_motion(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotation (3, 3) and translation (3,) from the coils as they were given to the model's frame."""
        rotation, translation = self._rigid(unknowns)
        return rotation @ self._guess.rotation, rotation @ self._guess.translation_mm + translation

    def moved(self, unknowns: FloatArray) -> FloatArray:
        """(T, n, 3) the shown frames in the model's frame."""
        rotation, translation = self._rigid(unknowns)
        there = self.shown @ rotation.T + translation
        if self._midsagittal:
            there[:, :, 0] = 0.0
        return np.ascontiguousarray(there)

    # J ----------------------------------------------------------------------------------------------

    def _counts(self) -> tuple[float, float]:
        """P and N."""
        poses = self._independent(self._poses_seen)
        return poses, max(poses, self._independent(min(self._residuals_seen, MOST_INDEPENDENT)))

    def _independent(self, frames: float) -> float:
        """How many independent frames so many are worth whose device noise is new in each."""
        repeated = 1.0 - min(DEVICE_NOISE_MM / self.noise_mm, 1.0) ** 2
        return frames / (1.0 + (frames - 1) * repeated)

    def speaker(self, unknowns: FloatArray) -> FloatArray:
        """(m,) raw weights."""
        return np.asarray(self._model.speaker.mean + self._speaker_sd * unknowns[self.size :])

    def value(self, unknowns: FloatArray, places: Places, noise_mm: float) -> float:
        """J with another noise."""
        own, self.noise_mm = self.noise_mm, noise_mm
        value = self._value(unknowns, places)[0]
        self.noise_mm = own
        return value

    def _value(self, unknowns: FloatArray, places: Places) -> tuple[float, FrameTerms, Term | None]:
        """J; of it, the frames' terms and the palate's."""
        frame = self._frame_terms(unknowns, places, self.noise_mm)
        poses, frames = self._counts()
        value = poses * frame.whole.value + (frames - poses) * frame.beside.value
        value += 0.5 * float(unknowns[self.size :] @ unknowns[self.size :])
        away = unknowns[: self.size] / self._sd
        value += 0.5 * float(away @ away) + self._cost_of_sliding(places)
        if self._palate is None:
            return value, frame, None
        bound = self._bound(unknowns, places, frame)
        return value + bound.value, frame, bound

    def _cost_of_sliding(self, places: Places) -> float:
        """Of places beside the middle, and of the tip's from the usual one."""
        value = 0.0
        for index in self._middle:
            value += 0.5 * float(self._mean[places[index], 0] ** 2) / ASIDE_SD_MM**2
            if self._roles[index] == "tongue_tip":
                slid = float(self._along[places[index]]) - USUAL_PLACES_MM["tongue_tip"]
                value += 0.5 * (slid / TIP_PLACE_SD_MM) ** 2
        return value

    def _value_and_slope(self, unknowns: FloatArray, places: Places) -> tuple[float, FloatArray]:
        """J and its derivatives (k,)."""
        value, frame, bound = self._value(unknowns, places)
        poses, frames = self._counts()
        speaker_slope, by_motion = (
            poses * whole + (frames - poses) * beside
            for whole, beside in zip(frame.whole[1:], frame.beside[1:], strict=True)
        )
        if bound is not None:
            speaker_slope, by_motion = speaker_slope + bound.slope, by_motion + bound.motion_slope
        slope = np.concatenate([unknowns[: self.size] / self._sd**2, unknowns[self.size :]])
        slope[: self._shifts] += by_motion[3, -self._shifts :]
        turned = self._motion_and_slopes(unknowns)[1][: self.size - self._shifts]
        slope[self._shifts : self.size] += np.tensordot(turned, by_motion)
        slope[self.size :] += speaker_slope * self._speaker_sd
        return value, slope

    def _frame_terms(self, unknowns: FloatArray, places: Places, noise_mm: float) -> FrameTerms:
        """The mean over the frames of their negative log likelihood, up to a constant."""
        if places not in self._at_places:
            seen = self._model.at(places)
            self._at_places[places] = (
                np.array(seen.core[:, :, self._axes], order="C"), np.array(seen.origin[self._axes]),
            )  # fmt: skip
        core, origin = self._at_places[places]
        rotation, translation = self._rigid(unknowns)
        found: FrameTerms = mean_frame(
            core, origin, self.speaker(unknowns), self._pose_mean, self._pose_covariance, self._middle_of_frames,
            self._spread, rotation, translation, self._axes, noise_mm,
        )  # fmt: skip
        return found

    def _bound(self, unknowns: FloatArray, places: Places, frame: FrameTerms) -> Term:
        """The palate's part; frame: the terms there."""
        rotation, translation = self._rigid(unknowns)
        found: Term = palate_bound(
            *self._contour_arrays, self._at_places[places][0], self.speaker(unknowns), self._pose_mean,
            self._pose_covariance, frame, self._under_palate, rotation, translation, self._axes, self.noise_mm,
            *self._palate_arrays, max(1, round(WORST_SHARE * len(self._under_palate))), PALATE_SD_MM,
        )  # fmt: skip
        return found

    def _poses(self, unknowns: FloatArray, frame: FrameTerms) -> FloatArray:
        """(T, n) the poses of the shown frames that the coils make most probable."""
        coils = self.moved(unknowns).reshape(len(self.shown), -1)[:, self._axes]
        return np.asarray(self._pose_mean + (coils + frame.off) @ frame.gain.T)

    def heights(self, contours: FloatArray, unknowns: FloatArray) -> FloatArray:
        """(T,) mm by which contours (T, c, 3) rise above the palate at the most; minus infinity without overlap."""
        assert self._palate is not None
        rotation, translation = self.whole_motion(unknowns)
        above = self._palate.above((contours - translation) @ rotation)
        return np.asarray(np.where(np.isnan(above), -np.inf, above).max(axis=1))

    # Its minimum ------------------------------------------------------------------------------------

    def settle(self, unknowns: FloatArray, places: Places, rounds: int, adaptive: bool) -> _Found:
        """Unknowns and places in turn, until neither changes; adaptive: the noise and which frames count too."""
        for _ in range(rounds):
            noise = self.noise_mm
            for _ in range(ADAPTATIONS if adaptive else 0):
                unknowns, _ = self._descend(unknowns, places)
                self._adapt(unknowns, places, COOLING * noise)
            unknowns, _ = self._descend(unknowns, places)
            found = self._slid(unknowns, places)
            if found == places and noise == self.noise_mm:
                found = self._slid_by_one(unknowns, places) if adaptive else places
                if found == places:
                    break
            places = found
        unknowns, value = self._descend(unknowns, places)
        return _Found(unknowns, places, value)

    def _descend(
        self, unknowns: FloatArray, places: Places, steps: int = FULL_STEPS, scaling: FloatArray | None = None
    ) -> tuple[FloatArray, float]:
        """BFGS.

        scaling: (k, k), J is about round in scaling^-1 @ unknowns; None where that is not known yet.
        """
        from scipy.optimize import minimize

        scaling = np.diag(self._units) if scaling is None else scaling

        def value_and_slope(scaled: FloatArray) -> tuple[float, FloatArray]:
            value, slope = self._value_and_slope(unknowns + scaling @ scaled, places)
            return value, scaling.T @ slope

        end = minimize(
            value_and_slope,
            np.zeros(len(unknowns)),
            jac=True,
            method="BFGS",
            options={"gtol": 1e-3, "maxiter": steps},
        )
        return np.asarray(unknowns + scaling @ end.x), float(end.fun)

    def _slid(self, unknowns: FloatArray, places: Places) -> Places:
        """The places after sliding coils along the contour; motion and speaker follow each trial."""
        cost = self._cost_of_places(unknowns, places, TRIAL_STEPS)
        places = slid_along_contour(places, self._middle, self._contour_size, cost)
        for stride in (4, 2, 1, 1):
            together = (
                self._moved_places(places, moves) for moves in _neighbours_moved(len(self._middle), stride)
            )
            places = min((places, *(one for one in together if one is not None)), key=cost)
        for index in self._lateral:
            trials = [places]
            for place in self._nearest_on_surface(unknowns, places, index):
                trials.append((*places[:index], place, *places[index + 1 :]))
            places = min(trials, key=cost)
        return places

    def _slid_by_one(self, unknowns: FloatArray, places: Places) -> Places:
        """The best of the places where each mid-sagittal coil has slid by one vertex or not, in every combination.

        Compared with the poses of the training: the recording's own have adapted to the places where they are.
        """
        own = self._pose_mean, self._pose_covariance
        self._pose_mean, self._pose_covariance = self._training_poses
        unknowns, _ = self._descend(unknowns, places)
        cost = self._cost_of_places(unknowns, places, FULL_STEPS)
        best = places
        for moves in product((-1, 0, 1), repeat=len(self._middle)):
            trial = self._moved_places(places, moves)
            if trial is not None:
                best = min(best, trial, key=cost)
        if best == places:
            self._pose_mean, self._pose_covariance = own
        return best

    def _cost_of_places(self, unknowns: FloatArray, places: Places, steps: int) -> Callable[[Places], float]:
        """J of other places nearby, to which motion and speaker follow; remembered."""
        known: dict[Places, float] = {}
        scaling = np.asarray(np.linalg.cholesky(self._covariance(unknowns, places)), dtype=np.float64)

        def cost(trial: Places) -> float:
            if trial not in known:
                known[trial] = self._descend(unknowns, trial, steps, scaling)[1]
            return known[trial]

        return cost

    def _moved_places(self, places: Places, moves: Sequence[int]) -> Places | None:
        """Each mid-sagittal coil slid by its move, the lateral ones taken along; None where that is no order."""
        trial = np.array(places)
        trial[self._middle] += moves
        slid = trial[self._middle]
        if slid.size == 0 or slid.min() < 0 or slid.max() >= self._contour_size or (np.diff(slid) <= 0).any():
            return None
        before = [places[index] for index in self._middle]
        shift = (self._mean[slid] - self._mean[before]).mean(axis=0)
        for index in self._lateral:
            away = np.linalg.norm(
                self._mean[self._contour_size :] - self._mean[places[index]] - shift, axis=1
            )
            trial[index] = self._contour_size + int(np.argmin(away))
        return tuple(int(place) for place in trial)

    def _nearest_on_surface(self, unknowns: FloatArray, places: Places, index: int) -> list[int]:
        """The places on the upper surface that are nearest to a lateral coil on average over the frames."""
        frame = self._frame_terms(unknowns, places, self.noise_mm)
        shapes = _shapes(self._surface, self.speaker(unknowns), self._poses(unknowns, frame))
        apart = np.linalg.norm(shapes - self.moved(unknowns)[:, index][:, None], axis=2)
        nearest = np.argsort(apart.mean(axis=0), kind="stable")[:LATERAL_TRIALS]
        return [self._contour_size + int(place) for place in nearest]

    def _adapt(self, unknowns: FloatArray, places: Places, least_noise_mm: float) -> None:
        """The frames that are no outliers, their poses, and the noise that makes them most probable."""
        frame = self._frame_terms(unknowns, places, self.noise_mm)
        rotation, translation = self._rigid(unknowns)
        off = (self._coils @ rotation.T + translation).reshape(len(self._coils), -1)[
            :, self._axes
        ] + frame.off
        unlikely = np.einsum("ta,ab,tb->t", off, frame.inverse, off)
        kept = unlikely <= OUTLIER_MEDIANS * np.median(unlikely)
        self._summarise(kept)
        # The recording's own poses count beside those of the model's training by how many they are.
        training = self._model.pose
        seen = self._independent(self._poses_seen)
        own = seen / (seen + training.entries)
        poses = self._pose_mean + off[kept] @ frame.gain.T
        unsure = self._pose_covariance - frame.gain @ frame.directions.T @ self._pose_covariance
        mean = (1.0 - own) * training.mean + own * poses.mean(axis=0)
        left = off[kept] - (poses - self._pose_mean) @ frame.directions
        self._residuals_seen = float(np.median(effective_frames(left)))
        away = poses - mean
        believed = np.diag(_measured_sigma(training) ** 2) + np.outer(
            training.mean - mean, training.mean - mean
        )
        self._pose_mean = mean
        self._pose_covariance = (1.0 - own) * believed + own * (away.T @ away / len(away) + unsure)
        if self._poses_seen * (len(self._axes) - training.size) <= len(self._units):
            return  # motion and speaker follow so few poses whatever the noise is
        noises = NOISES_MM[NOISES_MM >= least_noise_mm]
        likely = [self._frame_terms(unknowns, places, noise).whole.value for noise in noises]
        self.noise_mm = float(noises[int(np.argmin(likely))])

    def _covariance(self, unknowns: FloatArray, places: Places) -> FloatArray:
        """(k, k) of the unknowns, from the curvature of J there; the vertices are held."""
        slopes = np.zeros((len(self._units),) * 2)
        for index, unit in enumerate(self._units):
            move = np.zeros(len(self._units))
            move[index] = CURVATURE_STEP * unit
            slopes[index] = self._value_and_slope(unknowns + move, places)[1]
            slopes[index] -= self._value_and_slope(unknowns - move, places)[1]
        curvature = slopes * self._units / (2.0 * CURVATURE_STEP)
        curvature = 0.5 * (curvature + curvature.T)
        # The priors alone make every direction at least this curved; kinks of the palate must not undo that.
        values, vectors = np.linalg.eigh(curvature)
        least = float(min(1.0, np.min((self._units[: self.size] / self._sd) ** 2)))
        covariance = vectors @ np.diag(1.0 / np.maximum(values, least)) @ vectors.T
        return np.asarray(covariance * np.outer(self._units, self._units))

    def standard_deviations(self, found: _Found) -> FloatArray:
        """(3,) or (6,) of the motion, mm and degrees; the speaker is not held."""
        seen, self._residuals_seen = self._residuals_seen, min(self._residuals_seen, SURE_FRAMES)
        deviations = np.sqrt(np.diag(self._covariance(found.unknowns, found.places)))[: self.size]
        self._residuals_seen = seen
        return self._in_degrees(deviations)

    def guess_deviations(self) -> FloatArray:
        """(3,) or (6,) how far the guess may be wrong, mm and degrees."""
        return self._in_degrees(self._sd)

    def _in_degrees(self, motion: FloatArray) -> FloatArray:
        return np.concatenate([motion[: self._shifts], np.degrees(motion[self._shifts :])])

    def deviations_from_guess(self, unknowns: FloatArray) -> FloatArray:
        """The motion in standard deviations of the guess."""
        return np.asarray(unknowns[: self.size] / self._sd)


def _measured_sigma(mode: Mode) -> FloatArray:
    """The deviation of each weight over the training entries. The published sigma is the same for all weights, but
    the one that carries the mean is really 4 to 18 times stiffer."""
    return mode.sigma if mode.measured_sigma is None else np.maximum(mode.measured_sigma, 1e-6)


def _shapes(model: TongueModel, speaker: FloatArray, poses: FloatArray) -> FloatArray:
    """(T, V, 3) mm: the model's vertices for one speaker (m,) in the poses (T, n)."""
    directions = np.tensordot(speaker, model.core, axes=1)
    return np.asarray((model.origin + poses @ directions).reshape(len(poses), -1, 3))


def _believable(sure: FloatArray, guess_sd: FloatArray, away: FloatArray) -> FloatArray:
    """The standard deviations of a fit, in the units of those of its guess; away: from the guess, in the latter. A fit
    that contradicts its guess is stated so unsure that it is within CONTRADICTION of it."""
    worst = float(np.abs(away).max())
    return sure if worst <= CONTRADICTION else np.maximum(sure, guess_sd * worst / CONTRADICTION)


def _neighbours_moved(coils: int, stride: int) -> list[list[int]]:
    """The moves that slide two or more neighbouring coils together, by the stride: all of them follow a wrong motion
    along the tongue, some of them a wrong speaker."""
    found = []
    for first, last in combinations(range(coils + 1), 2):
        if last - first > 1:
            inside = [int(first <= coil < last) for coil in range(coils)]
            found += [[sign * stride * one for one in inside] for sign in (-1, 1)]
    return found


def _poses_seen(series: FloatArray) -> float:
    """How many independent poses coils (T, a) mm show: a movement within the device's noise is none."""
    moving = float(np.median(series.var(axis=0)))
    shown = max(0.0, 1.0 - DEVICE_NOISE_MM**2 / max(moving, 1e-12))
    return 1.0 + (float(np.median(effective_frames(series))) - 1.0) * shown


def _near_their_medians(coils: FloatArray) -> NDArray[np.bool_]:
    """(frames,) whether no coil of (frames, n, 3) is far outside its usual range."""
    away = np.linalg.norm(coils - np.median(coils, axis=0), axis=2)
    return np.asarray((away <= OUTLIER_MEDIANS * np.maximum(np.median(away, axis=0), 1.0)).all(axis=1))


def _evenly(frames: FloatArray, most: int) -> FloatArray:
    """At most so many frames, spread through all of them."""
    return frames[np.unique(np.linspace(0, len(frames) - 1, most).astype(int))]


def _sentences(
    found: Registration, posterior: _Posterior, motion: FloatArray, guess: FirstGuess
) -> tuple[str, ...]:
    names = ("y", "z") if posterior.size == 3 else ("x", "y", "z")
    turns = ("pitch",) if posterior.size == 3 else ("about x", "about y", "about z")
    shifts = motion[: len(names)]
    angles = np.degrees(motion[len(names) : posterior.size])
    moved = ", ".join(
        [f"{n} {v:+.1f} +- {s:.1f} mm" for n, v, s in zip(names, shifts, found.sure, strict=False)]
        + [
            f"{n} {v:+.1f} +- {s:.1f} degrees"
            for n, v, s in zip(turns, angles, found.sure[len(names) :], strict=True)
        ]
    )
    told = [
        f"alignment (fitted to the model, from {guess.source}): {moved}, about the middle of the coils",
        (
            f"residual of the jointly estimated speaker: {found.residual_mm:.2f} mm; before the fit, with the same "
            f"vertices, {found.residual_before_mm:.2f} mm"
        ),
        f"correspondences (fitted with the alignment): {found.correspondences}",
    ]
    worst = float(np.abs(posterior.deviations_from_guess(motion)).max())
    if worst > CONTRADICTION:
        told.append(
            f"note: the fit contradicts {guess.source} by {worst:.1f} standard deviations, so its own are stated as no "
            f"less than {worst / CONTRADICTION:.1f} times those of that; look at the contours before it is believed"
        )
    elif worst > FAR_FROM_GUESS:
        told.append(
            f"note: the fit is {worst:.1f} standard deviations away from {guess.source}; look at the contours before "
            "it is believed"
        )
    if np.isfinite(found.palate_margin_mm):
        where = "above" if found.palate_margin_mm > 0 else "below"
        told.append(
            f"palate: in 99 % of the sampled frames the contour stays {abs(found.palate_margin_mm):.1f} mm {where} it "
            "or lower"
        )
    return tuple(told)
