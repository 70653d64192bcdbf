"""Where SUMO is installed."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

from egvs.core.errors import MissingBackendError


def sumo_home() -> Path:
    """Return SUMO's folder: the environment variable SUMO_HOME, else the installed package."""
    if home := os.environ.get("SUMO_HOME"):
        return Path(home)
    spec = importlib.util.find_spec("sumo")
    if spec is None or not spec.submodule_search_locations:
        raise MissingBackendError("SUMO is not installed. Set SUMO_HOME, or run pip install eclipse-sumo")
    return Path(spec.submodule_search_locations[0])
