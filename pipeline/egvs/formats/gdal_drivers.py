"""Let GDAL know one driver only, so that no file can be opened as something else.

GDAL chooses the driver by the content of a file, and some drivers do what the content says: an OGR VRT, for example,
opens other files and addresses, and runs SQL. The drivers to leave out must be known before the library registers them,
when it is imported. So a process that reads with GDAL starts itself again, with their names in GDAL's option
``GDAL_SKIP`` (https://gdal.org/en/stable/user/configoptions.html). Only for such a process, see
:mod:`egvs.formats.reader_process`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Collection

_SKIP = "GDAL_SKIP"


def keep_driver(name: str, registered: Collection[str]) -> None:
    """Return if a driver is the only one that is registered; else start this process again without the others.

    Parameters
    ----------
    name
        GDAL's short name, e.g. ``"GPKG"``.
    registered
        Names of the drivers that the library has registered.

    Raises
    ------
    ValueError
        When the driver is not there, or others are although they were to be left out.
    """
    others = sorted(set(registered) - {name})
    if name not in registered:
        raise ValueError(f"this GDAL cannot read {name}")
    if not others:
        return
    if _SKIP in os.environ:
        raise ValueError(f"GDAL cannot leave out {', '.join(others)}")
    arguments = [sys.executable, *sys.orig_argv[1:]]
    os.execve(sys.executable, arguments, os.environ | {_SKIP: ",".join(others) + ","})  # a comma, or spaces separate
