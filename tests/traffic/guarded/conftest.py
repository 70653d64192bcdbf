"""A place that hostile files stand in."""

import shutil
from pathlib import Path

import pytest

from tests.traffic.guarded.lanes import KEPT, first_lane


@pytest.fixture
def place(town, tmp_path) -> Path:
    """A folder with the town and a car's route; a file beside it that is not SUMO's."""
    folder = tmp_path / "in"
    folder.mkdir()
    shutil.copy(town / "net.xml", folder)
    edge = first_lane(town / "net.xml")[0]
    route = f'<vehicle id="v" depart="0"><route edges="{edge}"/></vehicle>'
    (folder / "own.rou.xml").write_text(f"<routes>{route}</routes>")
    (tmp_path / "foreign.txt").write_text(KEPT)
    return folder
