"""Public names of the extension: each works as the first import of a process, and has a docstring."""

from __future__ import annotations

from pathlib import Path

import pytest

from egvs.extensions import validation
from tests import public_names
from tests.public_names import run_folder  # noqa: F401 - a fixture

USES = {
    "FrameSampling": "FrameSampling(30).spacing_s is None",
    "validate_sites": "validate_sites.__kwdefaults__['jobs'] is None",
}
"""Public name to an expression that uses it, in a folder with a scenario and its run."""


@pytest.mark.slow
@pytest.mark.system
def test_each_public_name_works_as_first_import_and_has_docstring(run_folder: Path) -> None:  # noqa: F811
    public_names.check(validation, {name: USES[name] for name in validation.__all__}, run_folder)
