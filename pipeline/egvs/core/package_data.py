"""Where the files are that come with this program: the folders ``scenarios`` and ``data_schemas``.

A wheel contains them inside the package; in a checkout they are folders of the top level, beside ``pipeline``.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from egvs.core.errors import MissingBackendError

SCHEMAS = "data_schemas"
"""Folder of the schemas of artefacts."""


def data_folder(name: str) -> Path:
    """Return the folder ``name`` of the files that come with this program.

    Parameters
    ----------
    name
        ``"scenarios"`` or ``"data_schemas"``.

    Raises
    ------
    MissingBackendError
        When there is no such folder: the installation is damaged.
    """
    package = Path(str(resources.files("egvs")))
    in_wheel, in_checkout = package / name, package.parents[1] / name
    for folder in (in_wheel, in_checkout):
        if folder.is_dir():
            return folder
    raise MissingBackendError(f"{in_wheel}: expected a folder that comes with egvs. Install egvs again.")
