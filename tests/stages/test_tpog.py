"""What the record of traffic shows: too little of it, vehicles in solids, sites where vehicles drive."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import egvs
from egvs.scoring import occupancy
from tests.stages.test_check import box, sites, statics


def warnings(folder: Path, out: Path, *settings: str) -> dict[str, list[str]]:
    """The warnings of a run, by stage."""
    record = egvs.run(egvs.load(folder, settings), out)
    read = json.loads((out / "run.json").read_text())["stages"]
    told = {
        name: [w["where"] + ": " + w["problem"] for w in read[name]["summary"].get("warnings", [])]
        for name in record.stages
    }
    return {name: lines for name, lines in told.items() if lines}


@pytest.mark.slow
def test_two_vehicles_per_frame_are_enough(mini: Path, tmp_path: Path) -> None:
    """Two cars pass each other along the whole region, but in the first and last frames one of them is outside."""
    assert list(occupancy.warn_empty_region(2.0, tmp_path / "is not read")) == []
    assert warnings(mini, tmp_path / "out") == {}
    (one,) = occupancy.warn_empty_region(1.0, tmp_path / "is not read")
    assert one.problem.startswith("1 vehicle is in the region on average")
    (people,) = occupancy.warn_empty_region(1.2, tmp_path / "is not read", people=True)
    assert people.problem.startswith("1.2 road users are in the region on average")
    few = warnings(mini, tmp_path / "few", "roi.center_m=[30,0,2.5]", "roi.size_m=[20,20,5]")
    assert len(few["tpog"]) == 1
    assert few["tpog"][0].endswith(
        " vehicles are in the region on average, so the ranking is based on very little traffic"
    )


def test_warns_of_region_without_vehicles(mini: Path, tmp_path: Path) -> None:
    sites(mini, "a,10,52,3")
    told = warnings(mini, tmp_path / "out", "roi.center_m=[20,60,2.5]")
    assert told == {
        "tpog": [
            "roi: no vehicle ever enters the region, all are between (-1, -2) and (41, 3): the sites cannot be ranked"
        ],
        "score": [
            "scenario.toml: roi: egvs is 0 at every site, so there is no ranking:"
            " the traffic in the region never changes"
        ],
    }


@pytest.mark.slow
def test_warns_of_vehicles_driving_through_solid(mini: Path, tmp_path: Path) -> None:
    """A wall across the lane of one car, which goes through it at 2 m a second; the house is beside the road."""
    statics(mini, box((20, -3), (22, -1), "wall", kind="wall"), box((14, 5), (18, 8), "house", height_m=6))
    lines = warnings(mini, tmp_path / "out")["tpog"]
    assert len(lines) == 1
    share, _, rest = (
        lines[0]
        .removeprefix("statics: ")
        .partition("% of the volume that vehicles occupy is inside solids, most often at (")
    )
    assert 2 < float(share) < 4  # about 2 of 38 m of one car of two
    x, y, z = (float(value) for value in rest.partition(")")[0].split(", "))
    assert (20 <= x <= 22, -3 <= y <= -1, 0 <= z <= 1.5) == (True, True, True)
    assert rest.endswith("), in wall (wall)")


@pytest.mark.parametrize(
    ("row", "is_found"), [("in,20,-2,3", True), ("gantry,20,-2,4.6", False), ("off,20,-4,3", False)]
)
def test_warns_of_site_where_vehicles_drive(mini: Path, tmp_path: Path, row: str, is_found: bool) -> None:
    """With a finished file the record alone tells the road: the car of 1.8 m drives along y = -2."""
    sites(mini, row)
    told = warnings(mini, tmp_path / "out")
    assert list(told) == (["score"] if is_found else [])
    if is_found:
        assert told["score"][0].startswith("site in: vehicles drive through its position (20, -2) in ")
