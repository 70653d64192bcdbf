"""Runs to export: one that says where it lies, and one that does not."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline import load
from pipeline.runs import workflow
from tests.conftest import write_mini

EPSG, OFFSET_M = 25832, (-550000.0, -5630000.0)
"""UTM zone 32, and what is added to eastings and northings to reach the scenario's x, y."""


def _made(folder: Path, text: str = "", sites: str | None = None) -> Path:
    scenario = write_mini(folder / "mini")
    file = scenario / "scenario.toml"
    file.write_text(file.read_text() + text)
    if sites is not None:
        (scenario / "sites.csv").write_text(sites)
    workflow.run(load(scenario), folder / "run")
    return folder / "run"


@pytest.fixture(scope="session")
def located(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in UTM zone 32; its sites have columns of the user's own, some called as a format's."""
    text = f"\n[crs]\nepsg = {EPSG}\noffset_m = [{OFFSET_M[0]}, {OFFSET_M[1]}]\n"
    sites = (
        "site,x_m,y_m,z_m,fid,Geometry,note\n"
        "pole_a,10,12,3,7,old,=1+1\n"
        "pole & <b>,30.5,-12,3.25,7,new,\"it's, 'quoted'\"\n"
    )  # fmt: skip
    return _made(tmp_path_factory.mktemp("located"), text, sites)


@pytest.fixture(scope="session")
def local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of which nobody knows where it lies."""
    return _made(tmp_path_factory.mktemp("local"))
