"""Runs and road networks that tests of effects share."""

from __future__ import annotations

from pathlib import Path

import pytest

import egvs
from egvs.stages import traffic
from tests.conftest import SCENARIO, SITES
from tests.effects.detect_helpers import run_stages, write_scenario
from tests.effects.road_helpers import CROWD, GRADE, SMALL, build_road, read_rows, road_scenario
from tests.effects.scan_helpers import TREES, write_scene
from tests.stage_runner import run_stage


@pytest.fixture(scope="module")
def score_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A scenario folder with two sites, and the folder with its artefacts."""
    top = tmp_path_factory.mktemp("detect")
    return run_stages(write_scenario(top / "mini", SCENARIO, SITES), top / "out")


@pytest.fixture(scope="module")
def one_beam_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same with one site and one beam: from x = -10 along x, through the voxels (ix, 20, 4)."""
    top = tmp_path_factory.mktemp("beam")
    scenario = (
        SCENARIO.replace("[-15, 5]", "[0]")
        .replace("channels = 8\n", "")
        .replace("azimuth_step_deg = 1.0", "azimuth_step_deg = 360")
    )
    return run_stages(write_scenario(top / "mini", scenario, "site,x_m,y_m,z_m\nonly,-10,0.25,2.25\n"), top / "out")


@pytest.fixture
def plain_scan_run(mini: Path, tmp_path: Path) -> Path:
    write_scene(mini, *TREES)
    egvs.run(egvs.load(mini), tmp_path / "plain", jobs=1)
    return tmp_path / "plain"


@pytest.fixture(scope="session")
def flat_road(tmp_path_factory):
    return build_road(tmp_path_factory.mktemp("flat"), 0)


@pytest.fixture(scope="session")
def hill_road(tmp_path_factory):
    return build_road(tmp_path_factory.mktemp("hill"), 300 * GRADE)


@pytest.fixture(scope="session")
def hill_run(hill_road, tmp_path_factory):
    """Result, rows and folder of the traffic on the hill road, with everything that acts there."""
    out = tmp_path_factory.mktemp("climbed")
    result = run_stage(traffic, road_scenario(hill_road, {"articulated": {}, **CROWD}, **SMALL), out)
    return result, read_rows(out), out
