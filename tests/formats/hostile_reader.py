"""A reader that tries what a confined process must not do; the outcome of each attempt is one value of its block."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from egvs.formats.reader_process import Block, serve


def attempts(path: Path, canary: Path) -> dict[str, Callable[[], object]]:
    """Return the attempts by name; the canary folder holds the file ``secret``."""
    return {
        "read the file": path.read_bytes,
        "write to the temporary folder": lambda: Path(os.environ["TMPDIR"], "x").write_text("x", encoding="utf-8"),
        "read another file": (canary / "secret").read_bytes,
        "list a folder": lambda: list(canary.iterdir()),
        "write a file": lambda: (canary / "new").write_text("x", encoding="utf-8"),
        "write to the file": lambda: path.write_text("x", encoding="utf-8"),
        "remove a file": (canary / "secret").unlink,
        "open a socket": socket.socket,
        "open a local socket": lambda: socket.socket(socket.AF_UNIX),
        "let another program read": lambda: subprocess.run(["/bin/cat", canary / "secret"], check=True),
    }


def read(path: Path) -> Iterator[Block]:
    """Yield one block with what became of each attempt."""
    outcomes = {}
    for name, attempt in attempts(path, Path(sys.argv[2])).items():
        try:
            attempt()
        except (OSError, subprocess.SubprocessError) as error:
            outcomes[name] = type(error).__name__
        else:
            outcomes[name] = "done"
    yield Block(outcomes | {"variables": sorted(os.environ)})


if __name__ == "__main__":
    serve(read)
