"""A window in which moments of a scene are shown, and what its keys and the mouse do there."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from ... import InputError
from .camera import View, home_view
from .drawing import Renderer
from .look import DARK, LIGHT, Look
from .scene import Moment, Scene

if TYPE_CHECKING:
    import moderngl

SIZE = (1100, 640)
SMALLEST = (480, 320)
PICTURES_HZ = 60.0
DEGREES_PER_PIXEL = 0.4
ZOOM_PER_STEP = 1.12
TRAILS_S = (0.5, 2.0, 0.0)
COLOURS = ("tissue", "palate", "uncertainty")
TIME_PX = 5
"""Height of the bar of time; it is grasped anywhere in the lowest `GRASPED_PX`."""
GRASPED_PX = 18
KEYS_IN_A_LINE = 4
HELP_S = 15.0
"""So long a new window shows what its keys do; afterwards `h` does."""
SAMPLES = 4
SOFTWARE = ("llvmpipe", "softpipe", "swiftshader", "swrast", "gdi generic")
"""Rasterisers on which smooth edges would cost most of the pictures."""
KEYS: Mapping[str, str] = {
    "mouse": "turn, zoom",
    "r": "reset view",
    "c": "colour",
    "x": "trails",
    "l": "light, dark",
    "h": "keys",
    "q": "close",
}
NO_DISPLAY = (
    "a window needs a display, and none could be opened ({reason}); on a computer without one there are --web and "
    "'tonguetrack render'."
)
NO_OPENGL = (
    "a window needs OpenGL 3.3, which could not be opened ({reason}); on Debian or Ubuntu install it with: "
    "apt install libgl1 libgl1-mesa-dri libegl1"
)


class Window:
    """An open window. A context manager, used in the main thread; one at a time.

        with Window(scene, "a take") as window:
            while not window.closed:
                window.show(moment)
                window.wait()

    view: how it is looked at, which the user changes with the mouse; colour_by of `view`, look and trails with keys.
    keys: what else keys do, for people, by name; pressed: called with a key that the window itself has no use for:
    a letter, or "left", "right", "up", "down", "home", "end". scrubbed: called with the place, 0 to 1, to which the
    user draws the time at the lower edge. Raises InputError with what is missing where it cannot be opened.
    """

    def __init__(
        self,
        scene: Scene,
        title: str,
        look: Look = DARK,
        keys: Mapping[str, str] | None = None,
        pressed: Callable[[str], None] = lambda key: None,
        scrubbed: Callable[[float], None] = lambda share: None,
        size: tuple[int, int] = SIZE,
    ) -> None:
        self.scene = scene
        self.view: View = home_view(scene)
        self.keys = {**(keys or {}), **KEYS}
        self.pressed, self.scrubbed = pressed, scrubbed
        self._help_until_s = time.perf_counter() + HELP_S
        self._glfw = glfw = _imported_glfw()
        self._complaints: list[str] = []
        glfw.set_error_callback(lambda code, words: self._complaints.append(_plain(words)))
        if not glfw.init():
            raise InputError(NO_DISPLAY.format(reason=self._complaint()))
        self._window: Any = None
        try:
            self._context = self._opened(title, size)
            self._look = look
            self._renderer = Renderer(self._context, scene, self._pixels(), look)
        except BaseException:
            glfw.terminate()
            raise
        self._dragged_from: tuple[float, float] | None = None
        self._scrubbing = self._has_time = False
        self._next_s = time.perf_counter()
        glfw.set_char_callback(self._window, lambda _, code: self.press(chr(code)))
        glfw.set_key_callback(self._window, self._on_key)
        glfw.set_mouse_button_callback(self._window, self._on_button)
        glfw.set_cursor_pos_callback(self._window, lambda _, x, y: self._on_move(x, y))
        glfw.set_scroll_callback(self._window, lambda _, x, y: self.view.zoom(ZOOM_PER_STEP**y))
        glfw.show_window(self._window)

    @property
    def closed(self) -> bool:
        """Whether the user has closed it."""
        return bool(self._glfw.window_should_close(self._window))

    @property
    def look(self) -> Look:
        return self._look

    @look.setter
    def look(self, look: Look) -> None:
        if look is not self._look:
            self._look = look
            self._renderer.release()
            self._renderer = Renderer(self._context, self.scene, self._pixels(), look)

    @property
    def help(self) -> tuple[str, ...]:
        """What keys do, as lines for the picture; after a while that `h` shows them again."""
        if time.perf_counter() > self._help_until_s:
            return (f"h: {KEYS['h']}",)
        words = [f"{key}: {words}" for key, words in self.keys.items()]
        return tuple(
            " | ".join(words[row : row + KEYS_IN_A_LINE]) for row in range(0, len(words), KEYS_IN_A_LINE)
        )

    def remember(self, moment: Moment) -> None:
        """Lets the coils' trails pass where nothing was drawn."""
        self._renderer.remember(moment)

    def show(self, moment: Moment, share: float | None = None) -> None:
        """Draws the moment as `view` says, with the keys below its lines. Nothing while the window is minimised.

        share: of the time that has passed, 0 to 1, as a bar at the lower edge; None = there is no end.
        """
        size = self._pixels()
        if 0 in size:
            return
        if size != self._renderer.size:
            self._renderer.resize(size)
        lines = self.view.lines
        self.view.lines = (*lines, *self.help)
        try:
            self._renderer.draw(moment, self.view, self._context.screen)
        finally:
            self.view.lines = lines
        self._has_time = share is not None
        if share is not None:
            self._draw_time(share, size)
        self._glfw.swap_buffers(self._window)

    def wait(self) -> None:
        """Handles keys and mouse until the next picture is due, `PICTURES_HZ` of them a second."""
        glfw = self._glfw
        glfw.poll_events()
        self._next_s = max(self._next_s + 1.0 / PICTURES_HZ, time.perf_counter())
        while (left_s := self._next_s - time.perf_counter()) > 0 and not self.closed:
            glfw.wait_events_timeout(left_s)

    def press(self, key: str) -> None:
        """What a key does: a letter as typed, or the name of another key."""
        match key.lower():
            case "q" | "escape":
                self._glfw.set_window_should_close(self._window, True)
            case "r":
                home = home_view(self.scene)
                self.view.yaw_deg, self.view.pitch_deg = home.yaw_deg, home.pitch_deg
                self.view.distance_mm = home.distance_mm
            case "c":
                colours = [name for name in COLOURS if name != "palate" or self.scene.palate is not None]
                self.view.colour_by = _after(self.view.colour_by, colours)
            case "x":
                self.view.trail_s = _after(self.view.trail_s, TRAILS_S)
            case "l":
                self.look = LIGHT if self._look is DARK else DARK
            case "h":
                hidden = time.perf_counter() > self._help_until_s
                self._help_until_s = float("inf") if hidden else 0.0
            case other:
                self.pressed(other)

    def close(self) -> None:
        """Gives everything back; the window is gone."""
        self._renderer.release()
        self._context.release()
        self._glfw.terminate()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _draw_time(self, share: float, size: tuple[int, int]) -> None:
        screen, look = self._context.screen, self._look
        passed = round(share * size[0])
        screen.clear(*look.line, viewport=(0, 0, size[0], TIME_PX))
        screen.clear(*look.bar, viewport=(0, 0, max(passed, 1), TIME_PX))
        screen.clear(*look.text, viewport=(max(passed - 2, 0), 0, 4, TIME_PX + 2))

    def _opened(self, title: str, size: tuple[int, int]) -> moderngl.Context:
        """The window, not shown yet, and its context. Smooth edges where a graphics card draws them."""
        import moderngl

        for samples in (SAMPLES, 0):
            self._make_window(title, size, samples)
            try:
                context = moderngl.create_context(require=330)
            except Exception as reason:  # the loader raises whatever its platform makes it stumble over
                raise InputError(NO_OPENGL.format(reason=_plain(reason))) from reason
            drawn_by = str(context.info["GL_RENDERER"]).lower()
            if not samples or not any(name in drawn_by for name in SOFTWARE):
                return context
            context.release()
            self._glfw.destroy_window(self._window)
        raise AssertionError

    def _make_window(self, title: str, size: tuple[int, int], samples: int) -> None:
        glfw = self._glfw
        glfw.default_window_hints()
        glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, 3)
        glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, 3)
        glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
        glfw.window_hint(glfw.OPENGL_FORWARD_COMPAT, True)
        glfw.window_hint(glfw.SAMPLES, samples)
        glfw.window_hint(glfw.VISIBLE, False)
        self._window = glfw.create_window(*size, title, None, None)
        if not self._window:
            raise InputError(NO_OPENGL.format(reason=self._complaint()))
        glfw.set_window_size_limits(self._window, *SMALLEST, glfw.DONT_CARE, glfw.DONT_CARE)
        glfw.make_context_current(self._window)
        glfw.swap_interval(1)

    def _pixels(self) -> tuple[int, int]:
        width, height = self._glfw.get_framebuffer_size(self._window)
        return int(width), int(height)

    def _complaint(self) -> str:
        return self._complaints[-1] if self._complaints else "no reason given"

    def _on_key(self, _: Any, key: int, code: int, action: int, modifiers: int) -> None:
        glfw = self._glfw
        names = {
            glfw.KEY_LEFT: "left", glfw.KEY_RIGHT: "right", glfw.KEY_UP: "up", glfw.KEY_DOWN: "down",
            glfw.KEY_HOME: "home", glfw.KEY_END: "end", glfw.KEY_ESCAPE: "escape",
        }  # fmt: skip
        if key in names and action != glfw.RELEASE:
            self.press(names[key])

    def _on_button(self, _: Any, button: int, action: int, modifiers: int) -> None:
        self._dragged_from, self._scrubbing = None, False
        if action != self._glfw.PRESS:
            return
        x, y = self._glfw.get_cursor_pos(self._window)
        if self._has_time and y > self._glfw.get_window_size(self._window)[1] - GRASPED_PX:
            self._scrubbing = True
            self._on_move(x, y)
        else:
            self._dragged_from = (x, y)

    def _on_move(self, x: float, y: float) -> None:
        if self._scrubbing:
            self.scrubbed(x / self._glfw.get_window_size(self._window)[0])
        elif self._dragged_from is not None:
            from_x, from_y = self._dragged_from
            self.view.orbit(DEGREES_PER_PIXEL * (from_x - x), DEGREES_PER_PIXEL * (y - from_y))
            self._dragged_from = (x, y)


def _after(present: Any, choices: Any) -> Any:
    """The one after the present one, in a circle."""
    return choices[(list(choices).index(present) + 1) % len(choices)] if present in choices else choices[0]


def _plain(words: object) -> str:
    text = words.decode("utf-8", "replace") if isinstance(words, bytes) else str(words)
    return (text.splitlines() or ["no reason given"])[0].rstrip(".")


def _imported_glfw() -> Any:
    try:
        import glfw
        import moderngl  # noqa: F401
    except ImportError as reason:
        if getattr(reason, "name", "") not in ("glfw", "moderngl"):
            raise InputError(NO_DISPLAY.format(reason=_plain(reason))) from reason
        raise InputError(
            "the window needs the extra 'viewer': pip install 'tonguetrack[viewer]'."
        ) from reason
    return glfw
