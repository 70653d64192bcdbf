"""A reader that never ends, as a program: ``python -m tests.formats.endless_reader PATH``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from egvs.formats.reader_process import Block, serve


def read(path: Path) -> Iterator[Block]:
    """Yield nothing, and work."""
    del path
    while True:
        pass
    yield Block({})


if __name__ == "__main__":
    serve(read)
