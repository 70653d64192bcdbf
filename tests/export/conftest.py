"""Runs to export, with and without a reference system."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from egvs import load, place
from egvs.runs import run
from tests.conftest import collection, feature, write_mini

EPSG, OFFSET_M = 25832, (-550000.0, -5630000.0)
"""UTM zone 32, and the offset from eastings and northings to x, y of the scenario."""


def _make_run(folder: Path, text: str = "", sites: str | None = None) -> Path:
    scenario = write_mini(folder / "mini")
    file = scenario / "scenario.toml"
    file.write_text(file.read_text() + text)
    if sites is not None:
        (scenario / "sites.csv").write_text(sites)
    run.run(load(scenario), folder / "run")
    return folder / "run"


@pytest.fixture(scope="session")
def located(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in UTM zone 32; its sites file has user columns, some with names that formats reserve."""
    text = f"\n[crs]\nepsg = {EPSG}\noffset_m = [{OFFSET_M[0]}, {OFFSET_M[1]}]\n"
    sites = (
        "site,x_m,y_m,z_m,fid,Geometry,note\n"
        "pole_a,10,12,3,7,old,=1+1\n"
        "pole & <b>,30.5,-12,3.25,7,new,\"it's, 'quoted'\"\n"
    )  # fmt: skip
    return _make_run(tmp_path_factory.mktemp("located"), text, sites)


@pytest.fixture(scope="session")
def local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without a reference system."""
    return _make_run(tmp_path_factory.mktemp("local"))


HOUSE = [[150, 206], [158, 206], [158, 209.5], [150, 209.5], [150, 206]]
LAMP = (152.0, 252.0)


@pytest.fixture(scope="session")
def on_roads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with SUMO traffic: a minute on a shipped junction with two sites, and a plan with both."""
    scenario = tmp_path_factory.mktemp("on_roads") / "junction"
    shutil.copytree(Path(__file__).resolve().parents[2] / "scenarios" / "nishishinjuku", scenario)
    file = scenario / "scenario.toml"
    text = file.read_text()
    for long, short in (
        ("frames = 5000", "frames = 60"), ("warmup_s = 300", "warmup_s = 60"), ("vehicles = 50", "vehicles = 25"),
        ("frame_period_s = 0.25", "frame_period_s = 1"), ("step_s = 0.25", "step_s = 1"),
        ("voxel_m = 0.25", "voxel_m = 1.0"), ("gamma = 10", "gamma = 1000"),
    ):  # fmt: skip
        assert long in text
        text = text.replace(long, short)
    file.write_text(f"{text}\n[crs]\nepsg = {EPSG}\noffset_m = [{OFFSET_M[0]}, {OFFSET_M[1]}]\n")
    (scenario / "sites.csv").write_text("".join((scenario / "sites.csv").read_text().splitlines(keepends=True)[:12:5]))
    house = feature({"type": "Polygon", "coordinates": [HOUSE]}, name="house", kind="building", height_m=6.5)
    lamp = feature({"type": "Point", "coordinates": LAMP}, name="lamp", kind="pole", height_m=5, radius_m=0.1)
    (scenario / "statics.geojson").write_text(collection(house, lamp))
    loaded, out = load(scenario, ["placement.count=2"]), scenario.parent / "run"
    run.run(loaded, out)
    place(loaded, out)
    return out
