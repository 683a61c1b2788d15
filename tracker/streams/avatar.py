"""What drives an avatar: named numbers, made from a pose by the shapes and a preset's vocabulary."""

from __future__ import annotations

import numpy as np

from ... import InputError
from ..pose import FloatArray, TrackedPose
from .presets import Preset, load_preset
from .shapes import ShapeMeter
from .sink import StreamContext


class AvatarValues:
    """The values of a preset's targets for one pose after the other.

    signed: whether axes with two ends, -1..1, are among them; their ends are always there on their own, 0..1.
    names: (targets,) as the receiver knows them, with capitals as they are. Raises InputError where nothing is left.
    """

    def __init__(self, preset: Preset, meter: ShapeMeter, signed: bool) -> None:
        mixer = preset.mixer(meter.names)
        self._meter = meter
        self._mixer = mixer
        self._kept = np.flatnonzero(signed | (mixer.low >= 0.0))
        self.names = tuple(mixer.names[k] for k in self._kept)
        self._last = np.zeros(len(self.names))
        self.preset = preset.name
        if not self.names:
            raise InputError(
                f"preset {preset.name}: all its targets are signed, which is no use here; expected some in [targets]."
            )

    def values(self, pose: TrackedPose) -> FloatArray:
        """(targets,) of a pose, within 0..1 or -1..1; as they were last where the pose has no shape: an avatar would break."""
        if pose.has_shape:
            self._last = self._mixer(self._meter.measure(pose.speaker_weights, pose.weights))[self._kept]
        return self._last


def avatar_values(preset: str, context: StreamContext, signed: bool) -> AvatarValues:
    """What a preset of the package, or a preset file, makes of this run's poses.

    Raises InputError where there is no such preset, or it needs shapes that the model does not have.
    """
    return AvatarValues(load_preset(preset), ShapeMeter(context.model, context.ranges), signed)
