"""Looks at the ends of files that a program of SUMO wrote: on a full disk it ends without a word or an error."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from pipeline.core.errors import RunError

_TAIL_BYTES = 512


def check_table(path: Path) -> None:
    """RunError where a table does not end with a line."""
    if not tail(path).endswith(b"\n"):
        raise cut(path)


def check_xml(path: Path, root: str) -> None:
    """RunError where the root element of an XML file is not closed."""
    if re.search(rf"(</{root}>|<{root}[^<>]*/>)\s*\n\Z".encode(), tail(path)) is None:
        raise cut(path)


def cut(path: Path) -> RunError:
    """The error for a file that SUMO did not write to its end."""
    free_mb = shutil.disk_usage(path.parent).free / 1e6
    return RunError(f"{path}: SUMO did not write it to its end; is the disk full? ({free_mb:,.0f} MB are free there)")


def tail(path: Path) -> bytes:
    """The file's last bytes; none where there is no such file."""
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _TAIL_BYTES))
        return file.read()
