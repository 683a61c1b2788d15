"""The sound of a take, read piece by piece from any file that FFmpeg knows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ... import InputError

RATES_HZ = (8000, 11025, 12000, 16000, 22050, 24000, 32000, 44100, 48000)
"""What AAC takes and players play."""


class Sound:
    """Sound from some time on, in pieces that are asked for; before its beginning there is silence.

    rate_hz: samples a second; layout: "mono" or "stereo".
    """

    def __init__(self, pieces: Iterator[NDArray[np.float32]], rate_hz: int, layout: str) -> None:
        self.rate_hz, self.layout = rate_hz, layout
        self._pieces = pieces
        self._left: NDArray[np.float32] | None = None

    def skip(self, samples: int) -> bool:
        """Leaves out so many; whether any are left after them."""
        while samples > 0:
            piece = self.take(samples)
            if piece is None:
                return False
            samples -= piece.shape[1]
        self._left = self.take(1 << 30)
        return self._left is not None

    def precede(self, silence: int) -> None:
        """Puts so many samples of silence before what is left."""
        first, rest, channels = self._left, self._pieces, 1 if self.layout == "mono" else 2

        def quiet() -> Iterator[NDArray[np.float32]]:
            left = silence
            while left > 0:
                yield np.zeros((channels, min(left, self.rate_hz)), dtype=np.float32)
                left -= self.rate_hz
            if first is not None:
                yield first
            yield from rest

        self._left, self._pieces = None, quiet()

    def take(self, most: int) -> NDArray[np.float32] | None:
        """(channels, samples) the next ones, at most so many; None = there are no more."""
        while self._left is None or not self._left.shape[1]:
            self._left = next(self._pieces, None)
            if self._left is None:
                return None
        taken, self._left = self._left[:, :most], self._left[:, most:]
        return taken


def read_sound(path: Path, begin_s: float) -> Sound:
    """The sound of a file from `begin_s` on, counted from its first sample.

    Raises InputError where there is none, or none from then on. Needs the extra 'video'.
    """
    import av

    try:
        file = av.open(str(path))
    except (av.FFmpegError, OSError) as reason:
        raise InputError(f"{path}: the sound cannot be read ({_words(reason)}).") from reason
    if not file.streams.audio:
        file.close()
        raise InputError(f"{path}: there is no sound in it.")
    stream = file.streams.audio[0]
    rate_hz = min(RATES_HZ, key=lambda rate: (rate < min(stream.rate, RATES_HZ[-1]), rate))
    layout = "mono" if stream.channels == 1 else "stereo"

    def pieces() -> Iterator[NDArray[np.float32]]:
        resampler = av.AudioResampler(format="fltp", layout=layout, rate=rate_hz)
        try:
            with file:
                for frame in file.decode(stream):
                    frame.pts = None  # the samples follow each other
                    for piece in resampler.resample(frame):
                        yield np.asarray(piece.to_ndarray(), dtype=np.float32)
                for piece in resampler.resample(None):
                    yield np.asarray(piece.to_ndarray(), dtype=np.float32)
        except av.FFmpegError as reason:
            raise InputError(f"{path}: the sound cannot be read ({_words(reason)}).") from reason

    sound = Sound(pieces(), rate_hz, layout)
    samples = round(begin_s * rate_hz)
    if not sound.skip(max(samples, 0)):
        raise InputError(
            f"{path}: it has no sound at {begin_s:g} s, where the poses begin; sound and poses count their time from the "
            "same moment."
        )
    if samples < 0:
        sound.precede(-samples)
    return sound


def _words(reason: Exception) -> str:
    return str(getattr(reason, "strerror", None) or reason).splitlines()[0]
