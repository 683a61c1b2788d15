"""Valid bytes made wrong in every way that a wire, a disk or a stranger knows, and the bounds of one example."""

from __future__ import annotations

import signal
import threading
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hypothesis import strategies as st

HARD_LIMIT_S = 5.0
"""Of processor time for one example, so that a busy machine is no hang; whatever takes longer is interrupted."""
DEADLINE_S = 20.0
"""Of time on the wall for one example, for what waits instead of working."""
LARGEST = 1 << 17
"""Bytes of one example."""
PEAK_BYTES, PEAK_A_BYTE = 8 << 20, 300
"""Memory that one example may take while it runs: so much at all, and for each of its bytes."""
KEPT_BYTES = 1 << 20
"""Memory that may still be taken when an example is over."""

Seal = Callable[[bytes], bytes]


@dataclass(frozen=True)
class Seed:
    """Valid bytes. choice: what the parser needs to know beside them, as its row says."""

    data: bytes
    choice: int = 0


@dataclass(frozen=True)
class Example:
    """Bytes, perhaps no longer valid. cuts: sizes of the pieces in which a stream arrives, over and over."""

    data: bytes
    choice: int
    cuts: tuple[int, ...] = ()

    @property
    def pieces(self) -> list[bytes]:
        """The bytes as they arrive; b"" = nothing came in time."""
        out, at, turn = [], 0, 0
        while at < len(self.data):
            size = self.cuts[turn % len(self.cuts)] if any(self.cuts) else len(self.data)
            out.append(self.data[at : at + size])
            at, turn = at + size, turn + 1
        return out


Run = Callable[[Example, Path], int]


@dataclass(frozen=True)
class Parser:
    """A row of the table.

    run: parses one example, in a folder of its own, and returns how many bytes are held afterwards, 0 where
    nothing is kept; what it asserts is part of the specification. documented: all it may raise. holds: the
    most bytes that may be held. quick: examples in the usual profile. words: what the parser looks for, put in
    at any place. seal: makes check sums right again, so that damage gets past them. choices: of `Seed.choice`.
    """

    name: str
    seeds: tuple[Seed, ...]
    run: Run
    documented: tuple[type[Exception], ...] = ()
    holds: int = 0
    quick: int = 60
    words: tuple[bytes, ...] = ()
    seal: Seal | None = None
    choices: tuple[int, ...] = (0,)


# Mutations ------------------------------------------------------------------------------------------

TOKEN = frozenset(b"abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789.+-_")
Change = tuple[str, int, int, bytes]

EXTREMES = tuple(
    value.to_bytes(size, order)  # type: ignore[arg-type]
    for size in (1, 2, 4, 8)
    for value in (
        0,
        1,
        2 ** (8 * size - 1) - 1,
        2 ** (8 * size - 1),
        2 ** (8 * size) - 1,
        2 ** (8 * size) - 2,
    )
    for order in ("little", "big")
)
NUMBERS = tuple(
    b"0 -1 1e999 -1e999 nan inf 1e308 5e-324 65536 4294967296 9223372036854775808 99999999999999999999".split()
) + (b"9" * 400, b"9" * 5000, "٣".encode(), b"1_0", b"0x10", b" 7 ")


def changed(data: bytes, change: Change, others: Sequence[bytes]) -> bytes:
    """One mutation. Places are taken modulo what there is, so that every change means something."""
    kind, place, extent, piece = change
    size = len(data)
    at = place % (size + 1)
    end = min(size, at + 1 + extent)
    match kind:
        case "flip" if at < size:
            return data[:at] + bytes([data[at] ^ (1 + extent % 255)]) + data[at + 1 :]
        case "nudge" if at < size:
            return data[:at] + bytes([nudged(data[at], extent)]) + data[at + 1 :]
        case "token":
            begin, end = token_at(data, at)
            return data[:begin] + piece + data[end:]
        case "insert":
            return data[:at] + piece + data[at:]
        case "overwrite":
            return data[:at] + piece + data[at + len(piece) :]
        case "delete":
            return data[:at] + data[end:]
        case "double":
            return data[:end] + data[at:end] * (1 + extent % 3) + data[end:]
        case "move":
            rest = data[:at] + data[end:]
            to = extent * 7 % (len(rest) + 1)
            return rest[:to] + data[at:end] + rest[to:]
        case "cut":
            return data[:at]
        case "splice":
            other = others[extent % len(others)]
            return data[:at] + other[place * 31 % (len(other) + 1) :]
        case "append":
            return data + others[extent % len(others)]
    return data


def token_at(data: bytes, at: int) -> tuple[int, int]:
    """Where the word or number around a place begins and ends."""
    begin = end = min(at, len(data))
    while begin > 0 and data[begin - 1] in TOKEN:
        begin -= 1
    while end < len(data) and data[end] in TOKEN:
        end += 1
    return begin, end


def nudged(byte: int, by: int) -> int:
    """Another byte of the same kind: a digit for a digit, a letter for a letter, else one near by."""
    for alphabet in (
        b"0123456789",
        b"ABCDEF",
        b"GHIJKLMNOPQRSTUVWXYZ",
        b"abcdefghijklmnopqrstuvwxyz",
        b"+-.: ,",
    ):
        if byte in alphabet:
            return alphabet[(alphabet.index(byte) + 1 + by) % len(alphabet)]
    return (byte + (1, -1, 16, 128)[by % 4]) % 256


def examples(parser: Parser) -> st.SearchStrategy[Example]:
    """Examples for a parser: one to six changes of a seed, and now and then no relation to any."""
    seeds = parser.seeds
    longest = max(len(seed.data) for seed in seeds)
    places = st.integers(0, 63) | st.integers(0, longest)
    extents = st.integers(0, 8) | st.integers(0, 40) | st.integers(0, longest)
    kinds = ["nudge", "token"] * 3 + [
        "flip",
        "insert",
        "overwrite",
        "delete",
        "double",
        "move",
        "cut",
        "splice",
        "append",
    ]
    words = st.sampled_from(parser.words or NUMBERS)
    pieces = words | st.sampled_from(NUMBERS) | st.sampled_from(EXTREMES) | st.binary(max_size=12)
    change = st.tuples(st.sampled_from(kinds), places, extents, pieces)
    changes = st.one_of(*(st.lists(change, min_size=1, max_size=most) for most in (1, 1, 2, 6)))
    sealed = st.booleans() if parser.seal else st.just(False)
    cuts = st.just(()) | st.lists(st.integers(1, 40) | st.integers(0, longest), min_size=1, max_size=4)
    others = [seed.data for seed in seeds]

    def build(
        seed: Seed, todo: list[Change], seal: bool, pieces: Sequence[int], choice: int, keep: int
    ) -> Example:
        data = seed.data
        for change in todo:
            data = changed(data, change, others)[:LARGEST]
        if seal and parser.seal:
            data = parser.seal(data)
        return Example(data, seed.choice if keep else choice, tuple(pieces))

    made = st.builds(
        build,
        st.sampled_from(seeds),
        changes,
        sealed,
        cuts,
        st.sampled_from(parser.choices),
        st.integers(0, 3),
    )
    noise = st.builds(
        lambda parts, pieces, choice: Example(b"".join(parts), choice, tuple(pieces)),
        st.lists(words | st.sampled_from(NUMBERS) | st.binary(max_size=20), max_size=12),
        cuts,
        st.sampled_from(parser.choices),
    )
    return st.one_of(made, made, made, made, made, noise)


# Bounds ---------------------------------------------------------------------------------------------


class Hang(BaseException):
    """An example takes too long. No Exception, so that nothing on the way takes it for its own."""


@contextmanager
def interrupted_after(seconds: float) -> Iterator[None]:
    """Raises Hang within, after so much processor time; where there are no such signals, does nothing."""
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: object) -> None:
        raise Hang(f"still at work after {seconds:g} s")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def check(parser: Parser, example: Example, folder: Path) -> bool:
    """Runs one example within its bounds; whether it was accepted. Fails where it breaks one."""
    accepted, held = False, 0
    tracemalloc.start()
    try:
        with interrupted_after(HARD_LIMIT_S):
            try:
                held = parser.run(example, folder)
                accepted = True
            except parser.documented:
                pass
        kept, peak = tracemalloc.get_traced_memory()
    except Hang as reason:
        raise AssertionError(f"{parser.name}: {reason}") from None
    finally:
        tracemalloc.stop()
    allowed = PEAK_BYTES + PEAK_A_BYTE * len(example.data)
    assert peak <= allowed, f"{parser.name}: took {peak} bytes of memory for {len(example.data)}"
    assert kept <= KEPT_BYTES, f"{parser.name}: keeps {kept} bytes of memory"
    assert held <= parser.holds, f"{parser.name}: holds {held} bytes"
    return accepted
