"""A take as a film, as a sequence of pictures, or as one picture: drawn offscreen, frame by frame, as fast as that goes.

Poses are interpolated between the take's frames where the film has more of them. A file appears whole or not at all.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ...atomic import write_atomically
from .camera import home_view
from .captions import figures
from .look import DARK, Look
from .offscreen import Offscreen
from .playback import Ghost, check_times, moment_at
from .scene import Moments, Scene
from .sound import Sound, read_sound

if TYPE_CHECKING:
    from av.container import OutputContainer

SIZE = (1280, 720)
FPS = 60.0
SAMPLES = 4
SMALLEST_PX, LARGEST_PX = 160, 8192
LEAST_FPS, MOST_FPS = 0.01, 1000.0
MOST_ANIMATED_BYTES = 2 * 2**30
"""WebP and GIF are made of all their pictures at once, which are in memory until then."""
CRF = "18"  # of x264: hardly to be told from the pictures themselves
WEBP_QUALITY = 70
SOUND_CHUNK = 1024  # samples, as AAC has them in a frame
NO_VIDEO = "films need the extra 'video': pip install 'tonguetrack[video]'."

Picture = NDArray[np.uint8]
"""(height, width, 3) red, green and blue, the upper row first."""


@dataclass(frozen=True)
class Shot:
    """What is filmed, and how it looks. size: (width, height) pixels; fps: pictures a second.

    part_s: from when to when, in the poses' own time; None = all of it.
    """

    scene: Scene
    moments: Moments
    look: Look = DARK
    colour_by: str = "tissue"
    ghost: Ghost | None = None
    size: tuple[int, int] = SIZE
    fps: float = FPS
    part_s: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not all(SMALLEST_PX <= side <= LARGEST_PX for side in self.size):
            raise InputError(
                f"--size {self.size[0]}x{self.size[1]}: expected {SMALLEST_PX} to {LARGEST_PX} pixels each way."
            )
        if not LEAST_FPS <= self.fps <= MOST_FPS:
            raise InputError(f"--fps {self.fps:g}: expected {LEAST_FPS:g} to {MOST_FPS:g}.")
        times = self.moments.times_s
        check_times(times, self.scene.title)
        if self.part_s is not None and not times[0] <= self.part_s[0] < self.part_s[1] <= times[-1]:
            raise InputError(
                f"--seconds {self.part_s[0]:g}:{self.part_s[1]:g}: {self.scene.title} has the seconds "
                f"{times[0]:g} to {times[-1]:g}; give two of them, the first one first."
            )

    @property
    def begin_s(self) -> float:
        return float(self.moments.times_s[0]) if self.part_s is None else self.part_s[0]

    @property
    def picture_count(self) -> int:
        """From the first frame's time to the last one's."""
        end_s = float(self.moments.times_s[-1]) if self.part_s is None else self.part_s[1]
        return int((end_s - self.begin_s) * self.fps + 1e-6) + 1

    def pictures(self) -> Iterator[Picture]:
        """One after the other, `fps` for every second of the take."""
        with Offscreen(self.scene, self.size, self.look, SAMPLES) as drawing:
            for number in range(self.picture_count):
                yield self._drawn(drawing, self.begin_s + number / self.fps)

    def still(self, frame: int) -> Picture:
        """The picture of one frame, counted from 0, with the trails that lead there."""
        times = self.moments.times_s
        if not 0 <= frame < len(times):
            raise InputError(f"--frame {frame}: {self.scene.title} has the frames 0 to {len(times) - 1}.")
        with Offscreen(self.scene, self.size, self.look, SAMPLES) as drawing:
            trail_s = home_view(self.scene).trail_s
            for earlier in range(int(np.searchsorted(times, times[frame] - trail_s)), frame):
                drawing.renderer.remember(self.moments[earlier])
            return self._drawn(drawing, float(times[frame]))

    def _drawn(self, drawing: Offscreen, time_s: float) -> Picture:
        moment = moment_at(self.moments, time_s)
        view = home_view(self.scene)
        view.colour_by = self.colour_by
        view.ghost = None if self.ghost is None else self.ghost.at(time_s - self.begin_s)
        view.lines = figures(self.scene, moment)
        return drawing.picture(moment, view)


# Pictures -------------------------------------------------------------------------------------------


def write_still(picture: Picture, target: Path) -> None:
    """One PNG."""
    write_atomically(target, png(picture))


def write_pictures(pictures: Iterable[Picture], target: Path) -> None:
    """PNGs beside each other: tongue_000000.png and so on for the target tongue.png."""
    for number, picture in enumerate(pictures):
        write_atomically(numbered(target, number), png(picture, fast=True))


def numbered(target: Path, number: int) -> Path:
    """tongue.png -> tongue_000042.png."""
    return target.with_name(f"{target.stem}_{number:06d}{target.suffix}")


def png(picture: Picture, fast: bool = False) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG", compress_level=1 if fast else 9)
    return buffer.getvalue()


def check_animation(shot: Shot) -> None:
    """Raises InputError where the pictures of a WebP or GIF would be too many for a computer's memory."""
    needed = shot.picture_count * shot.size[0] * shot.size[1] * 3
    if needed > MOST_ANIMATED_BYTES:
        raise InputError(
            f"{shot.picture_count} pictures of {shot.size[0]}x{shot.size[1]} need {needed / 2**30:.1f} GiB of memory as a "
            f"picture that moves, {MOST_ANIMATED_BYTES / 2**30:g} at most; give --seconds, a smaller --size or --fps, or make a .mp4."
        )


def write_animation(pictures: Iterable[Picture], target: Path, fps: float) -> None:
    """A picture that moves, over and over, as WebP or GIF by the target's suffix: for pages that play no films.

    All its pictures are in memory at once; `check_animation` says whether that may be.
    """
    from PIL import Image

    kind = target.suffix[1:].upper()
    # GIF knows hundredths of a second only.
    unit_ms = 10 if kind == "GIF" else 1
    duration_ms = max(1, round(1000.0 / fps / unit_ms)) * unit_ms
    images = (Image.fromarray(picture) for picture in pictures)

    def write(file: BinaryIO) -> None:
        first = next(images)
        options: dict[str, Any] = {"quality": WEBP_QUALITY, "method": 4} if kind == "WEBP" else {}
        first.save(file, kind, save_all=True, append_images=images, duration=duration_ms, loop=0, **options)

    write_atomically(target, write)


# Films ----------------------------------------------------------------------------------------------


def can_film() -> bool:
    """Whether the extra 'video' is there."""
    try:
        import av  # noqa: F401
    except ImportError:
        return False
    return True


def write_film(
    pictures: Iterable[Picture],
    target: Path,
    fps: float,
    begin_s: float,
    size: tuple[int, int],
    audio: Path | None = None,
) -> None:
    """An MP4 with H.264, and AAC where there is sound, of pictures of this size (width, height).

    begin_s: the first picture's time, with the sound's first sample at 0; sound goes as far as the pictures do.
    Raises InputError without the extra 'video', for a size that H.264 does not take, and for sound that cannot be
    read or is all at another time.
    """
    if not can_film():
        raise InputError(NO_VIDEO)
    if any(side % 2 for side in size):  # colours are kept for two by two pixels
        even = "x".join(str(side + side % 2) for side in size)
        raise InputError(
            f"--size {size[0]}x{size[1]}: a film's width and height must be even, such as {even}."
        )
    sound = None if audio is None else read_sound(audio, begin_s)

    def write(file: BinaryIO) -> None:
        import av

        with av.open(file, "w", format="mp4") as film:
            _fill(film, pictures, fps, size, sound)

    write_atomically(target, write)


def _fill(
    film: OutputContainer,
    pictures: Iterable[Picture],
    fps: float,
    size: tuple[int, int],
    sound: Sound | None,
) -> None:
    """Pictures, and sound as far as they have got, so that neither waits in memory for the other."""
    import av

    rate = Fraction(fps).limit_denominator(1001)
    video: Any = film.add_stream("libx264", rate=rate, options={"crf": CRF})
    video.width, video.height = size
    video.pix_fmt = "yuv420p"
    voice: Any = None
    if sound is not None:
        voice = film.add_stream("aac", rate=sound.rate_hz)
        voice.layout = sound.layout
    done = 0  # samples
    for number, picture in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts, frame.time_base = number, 1 / rate
        film.mux(video.encode(frame))
        if sound is None:
            continue
        due = int((number + 1) / rate * sound.rate_hz)
        while done < due and (chunk := sound.take(min(SOUND_CHUNK, due - done))) is not None:
            film.mux(voice.encode(_spoken(chunk, done, sound)))
            done += chunk.shape[1]
    film.mux(video.encode(None))
    if voice is not None:
        film.mux(voice.encode(None))


def _spoken(samples: NDArray[np.float32], begin: int, sound: Sound) -> Any:
    import av

    frame = av.AudioFrame.from_ndarray(np.ascontiguousarray(samples), format="fltp", layout=sound.layout)
    frame.sample_rate = sound.rate_hz
    frame.pts, frame.time_base = begin, Fraction(1, sound.rate_hz)
    return frame
