"""The scenarios that come with this program."""

from __future__ import annotations

import shutil
from pathlib import Path

from egvs.core.errors import InputError
from egvs.core.package_data import data_folder
from egvs.scenario.model import SCENARIO_FILE

DEMO = "demo"
"""The scenario of ``egvs demo``; its traffic was simulated in advance, so that SUMO need not run."""


def shipped_scenario(name: str) -> Path:
    """Return the folder of a scenario that comes with this program, for :func:`egvs.load`.

    Parameters
    ----------
    name
        Name of the scenario, for example ``"nishishinjuku"``.

    Raises
    ------
    InputError
        When there is no such scenario; names those that there are.

    Examples
    --------
    >>> import egvs
    >>> egvs.load(egvs.shipped_scenario("roundabout")).name
    'roundabout'
    """
    if name not in shipped_names():
        raise InputError("scenario", f"expected one of {', '.join(shipped_names())}, got {name!r}")
    return data_folder("scenarios") / name


def shipped_names() -> list[str]:
    """Return the names of the scenarios that come with this program, sorted."""
    return sorted(path.parent.name for path in data_folder("scenarios").glob(f"*/{SCENARIO_FILE}"))


def copy_scenario(name: str, folder: Path) -> None:
    """Copy a scenario that comes with this program.

    Parameters
    ----------
    name
        Name of the scenario, for example :data:`DEMO`.
    folder
        The new folder; it is created, with its parents.

    Raises
    ------
    InputError
        When the folder contains something already, or cannot be created.
    """
    try:
        if folder.exists() and any(folder.iterdir()):
            problem = "expected a new or an empty folder, got one with files in it"
            raise InputError(folder, problem, "Choose another folder, or remove this one.")
        shutil.copytree(data_folder("scenarios") / name, folder, dirs_exist_ok=True, copy_function=shutil.copyfile)
    except OSError as error:
        raise InputError(
            folder, f"cannot be created ({error.strerror})", "Choose a folder that you may write."
        ) from None
