"""The page's server: a process of its own, which reads a feed and serves it to browsers.

    python -c "from tonguetrack.tracker.streams.page.server import main; main()" FOLDER HOST:PORT

prints one line, `page http://...`, when it listens, and ends with the run that writes the feed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from .... import InputError


def serve(folder: Path, address: str, said: Callable[[str], None]) -> None:
    """Serves the feed in `folder` at HOST:PORT until its run is over, or SIGTERM or SIGINT asks for an end.

    Port 0 is any free one. said: called with the line `page http://...` once it listens. Raises InputError where
    websockets is not installed, the folder holds no feed, or the address cannot be listened at.
    """
    try:
        from .serving import PageServer
    except ModuleNotFoundError as reason:
        if reason.name is None or not reason.name.startswith("websockets"):
            raise
        raise InputError("the page needs the extra 'web': pip install 'tonguetrack[web]'.") from reason
    import asyncio

    from ..feed import FeedReader
    from .anatomy import Anatomy

    with FeedReader(folder) as feed:
        server = PageServer(feed, Anatomy(feed.about), address)
        asyncio.run(server.run(lambda url: said(f"page {url}")))


def main() -> None:
    """The process. Exit code 2 and one sentence on stderr where it cannot serve."""
    if len(sys.argv) != 3:
        print("usage: FOLDER HOST:PORT", file=sys.stderr)
        raise SystemExit(2)
    try:
        serve(Path(sys.argv[1]), sys.argv[2], lambda line: print(line, flush=True))
    except InputError as reason:
        print(f"tonguetrack: {reason}", file=sys.stderr)
        raise SystemExit(2) from reason


if __name__ == "__main__":
    main()
