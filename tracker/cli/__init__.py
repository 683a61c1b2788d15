"""The command line. Each family of commands is one module; their handlers import the work they do."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence

from ... import InputError, __version__

EXIT_BAD_INPUT = 2
EXIT_LEFT_OUT = 3
"""Of commands that work on many things: some of them could not be used, each was told in a sentence, the rest is done."""


def build_parser() -> argparse.ArgumentParser:
    """The whole command line as an argparse parser."""
    from . import (
        anatomy,
        bench,
        calibrate,
        demo,
        devices,
        doctor,
        evaluate,
        experiment,
        export,
        files,
        live,
        model,
        monitor,
        mri,
        shapes,
        simulate,
        take,
        track,
        view,
    )

    parser = argparse.ArgumentParser(
        prog="tonguetrack",
        description="Electromagnetic articulography coils in, the whole moving tongue out.",
    )
    parser.add_argument("--version", action="version", version=f"tonguetrack {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for family in (
        demo, live, track, view, export, calibrate, anatomy, files, take, devices, doctor, model, mri, evaluate, experiment,
        simulate, monitor, shapes, bench,
    ):  # fmt: skip
        family.add_commands(commands)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command. Bad input is one sentence on stderr and exit code 2."""
    _show_what_the_terminal_cannot()
    args = build_parser().parse_args(arguments)
    try:
        return int(args.run(args))
    except InputError as reason:
        print(f"tonguetrack: {reason}", file=sys.stderr)
    except BrokenPipeError:
        # Whoever read our output has enough (`tonguetrack info FILE | head`).
        sys.stderr.close()
        return 0
    except OSError as reason:
        place = f"{reason.filename}: " if reason.filename else ""
        print(f"tonguetrack: {place}{reason.strerror or reason}.", file=sys.stderr)
    except MemoryError:
        print("tonguetrack: there is not enough memory for this.", file=sys.stderr)
    except KeyboardInterrupt:
        print("tonguetrack: stopped.", file=sys.stderr)
        return 130
    return EXIT_BAD_INPUT


def _show_what_the_terminal_cannot() -> None:
    """Letters that the terminal's encoding lacks (phones, names of files) come out as \\u0259, not as an error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
