"""Public names of the extension: each works as the first import of a process, and has a docstring."""

from __future__ import annotations

from pathlib import Path

import pytest

from egvs.extensions import hardware
from tests import public_names
from tests.public_names import run_folder  # noqa: F401 - a fixture

USES = {
    "DesignRequest": "DesignRequest('pole_a').channels is None",
    "accept": "accept.__kwdefaults__['max_vehicle_height_m'] == 4.5",
    "design_sensor": "from egvs import load; from egvs.extensions.hardware import DesignRequest; "
    "design_sensor(load('mini'), DesignRequest('pole_a', ('small',), evaluations=20), 'design').chosen.score > 0",
    "fit_sensor": "'sweeps' in fit_sensor.__annotations__",
    "read_sweeps": "read_sweeps([]) == []",
    "write_acceptance": "write_acceptance.__defaults__ == (None,)",
    "write_fit": "list(write_fit.__annotations__)[:2] == ['fit', 'name']",
    "write_sheets": "len(write_sheets('run', ['pole_a'], kind='svg', out=__import__('pathlib').Path('sheets'))) == 1",
}
"""Public name to an expression that uses it, in a folder with a scenario and its run."""


@pytest.mark.slow
@pytest.mark.system
def test_each_public_name_works_as_first_import_and_has_docstring(run_folder: Path) -> None:  # noqa: F811
    public_names.check(hardware, {name: USES[name] for name in hardware.__all__}, run_folder)
