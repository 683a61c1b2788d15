"""Pictures without a window, on any machine with an EGL library: a software one will do."""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from .drawing import Renderer, View
from .look import Look
from .scene import Moment, Scene

if TYPE_CHECKING:
    import moderngl

NO_EGL = (
    "pictures without a window need OpenGL 3.3 through EGL, which could not be opened ({reason}); on Debian or Ubuntu "
    "install it with: apt install libegl1 libgl1 libgl1-mesa-dri"
)


class Offscreen:
    """A renderer with a framebuffer of its own. A context manager.

    samples: of each pixel; 4 makes smooth edges, and takes several times as long on a software rasteriser.
    Raises InputError where the extra 'viewer' or the EGL library is missing.
    """

    def __init__(self, scene: Scene, size: tuple[int, int], look: Look, samples: int = 0) -> None:
        self.size = size
        self._context = egl_context()
        with (
            self._context
        ):  # other contexts of this process may come and go: each call makes its own the current one
            self._smooth = self._target(min(samples, self._context.max_samples)) if samples else None
            self._plain = self._target(0)
            self.renderer = Renderer(self._context, scene, size, look)

    @property
    def rasteriser(self) -> str:
        """What draws: the graphics card's name, or a software rasteriser's."""
        with self._context:
            return str(self._context.info["GL_RENDERER"])

    def picture(self, moment: Moment, view: View) -> NDArray[np.uint8]:
        """(height, width, 3) red, green and blue, the upper row first: a view of what lies in memory with a fourth
        value a pixel and the lower row first, for putting it in order costs as much as drawing all text."""
        with self._context:
            if self._smooth is None:
                self.renderer.draw(moment, view, self._plain)
            else:
                self.renderer.draw(moment, view, self._smooth)
                self._context.copy_framebuffer(self._plain, self._smooth)
            data = self._plain.read(components=4, alignment=1)
        width, height = self.size
        return np.frombuffer(data, dtype=np.uint8).reshape(height, width, 4)[::-1, :, :3]

    def _target(self, samples: int) -> moderngl.Framebuffer:
        context, size = self._context, self.size
        return context.framebuffer(
            [context.renderbuffer(size, 4, samples=samples)],
            context.depth_renderbuffer(size, samples=samples),
        )

    def close(self) -> None:
        """Gives everything back."""
        with self._context:
            self.renderer.release()
            for target in (self._plain, self._smooth):
                if target is not None:
                    for part in (*target.color_attachments, target.depth_attachment, target):
                        part.release()
        self._context.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def egl_context() -> moderngl.Context:
    """A context of OpenGL 3.3 without a window. Raises InputError with what to install."""
    try:
        import moderngl
    except ImportError as reason:
        raise InputError("drawing needs the extra 'viewer': pip install 'tonguetrack[viewer]'.") from reason
    try:
        create: Any = moderngl.create_context  # its own annotation of `backend` is wrong
        context: moderngl.Context = create(standalone=True, backend="egl", require=330)
        return context
    except Exception as reason:  # the loader raises whatever its platform makes it stumble over
        raise InputError(
            NO_EGL.format(reason=str(reason).splitlines()[0] if str(reason) else "no reason given")
        ) from reason
