"""Where SUMO is installed."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

from egvs.core.errors import InputError, MissingBackendError


def sumo_home() -> Path:
    """Return SUMO's folder: the environment variable SUMO_HOME, else the installed package.

    Raises
    ------
    InputError
        When SUMO_HOME names no folder.
    MissingBackendError
        When SUMO is not installed.
    """
    if home := os.environ.get("SUMO_HOME"):
        if not Path(home).is_dir():
            hint = "Set it to the folder of SUMO, or unset it to use the installed package."
            raise InputError("SUMO_HOME", f"expected a folder, got {home!r}", hint)
        return Path(home)
    spec = importlib.util.find_spec("sumo")
    if spec is None or not spec.submodule_search_locations:
        raise MissingBackendError("SUMO is not installed. Set SUMO_HOME, or run pip install eclipse-sumo")
    return Path(spec.submodule_search_locations[0])
