"""``egvs compare --assumed-heights``: the scenario again with other heights, and which of the best sites change."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from egvs.artefacts.run_record import RunRecord
from egvs.core.errors import InputError
from egvs.results.labels import SCORE_LABELS
from egvs.results.ranking import Ranking
from egvs.scenario import loading
from egvs.studies.assumed_heights import (
    HeightRun,
    HeightRuns,
    HeightSensitivity,
    RankedAgain,
    prepare_runs,
    scale_heights,
)
from tests.conftest import BUILDING, SITES, collection, feature

HIGH = "high,2,-15,9\n"
"""A site that looks over the wall if that is lower than as assumed."""

WALL = [[[0, -12], [40, -12], [40, -11], [0, -11], [0, -12]]]


def wall(height_from: str, height_m: float = 7.0) -> str:
    """A house beside the road, and a wall of assumed height between the road and the southern sites."""
    house_area = {"type": "Polygon", "coordinates": BUILDING}
    wall_area = {"type": "Polygon", "coordinates": WALL}
    lamp = {"type": "Point", "coordinates": [22, -5]}
    return collection(
        feature(house_area, name="house", kind="building", height_m=6, height_from="levels"),
        feature(wall_area, name="wall", kind="building", height_m=height_m, height_from=height_from),
        feature(lamp, name="lamp", kind="pole", height_m=5, radius_m=0.1, height_from="default"),
    )


@pytest.fixture
def here(mini: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The small scenario with a wall, in the current folder."""
    (mini / "statics.geojson").write_text(wall("default"))
    (mini / "sites.csv").write_text(SITES.replace("pole_b,30.5,-12,3\n", HIGH))
    monkeypatch.chdir(mini.parent)
    return mini.parent


def test_only_assumed_heights_of_buildings_change() -> None:
    document = json.loads(wall("neighbours"))
    changed = scale_heights(document, 0.7)
    assert [item["properties"]["height_m"] for item in changed["features"]] == [6, 4.9, 5]
    assert [item["properties"]["height_m"] for item in document["features"]] == [6, 7, 5]
    assert {key: value for key, value in changed.items() if key != "features"} == {
        "type": "FeatureCollection", "crs": None,
    }  # fmt: skip


@pytest.mark.slow
def test_ranks_change_with_the_wall(here: Path, run_egvs) -> None:
    code, printed, error = run_egvs("compare", "mini", "--assumed-heights")
    assert code == 0, error
    folders = sorted(path.name for path in (here / "runs").iterdir())
    assert folders == ["mini", "mini@assumed_heights=0.7", "mini@assumed_heights=1.3"]
    records = [RunRecord.read(here / "runs" / name).stages for name in folders]
    assert records[0]["traffic"].artefacts == records[1]["traffic"].artefacts == records[2]["traffic"].artefacts
    assert records[0]["scan"].artefacts != records[1]["scan"].artefacts
    lines = printed.splitlines()
    header = next(line for line in lines if line.startswith("site"))
    assert header.split("  ")[0] == "site" and "-30 %" in header and "+30 %" in header
    assert "The heights of 1 of 2 buildings are assumed; they were changed by -30 % and +30 %." in lines

    def score(name: str) -> float:
        ranking = Ranking.read(here / "runs" / name / "scores.parquet")
        return next(site.score for site in ranking.sites if site.site == "high")

    low, as_assumed, high = (score(folders[number]) for number in (1, 0, 2))
    assert low > as_assumed >= high, "a lower wall hides less"

    again = run_egvs("compare", "mini", "--assumed-heights")
    assert again[1] == printed
    stages = [line for line in again[2].splitlines() if not line.endswith("as in the run")]
    assert [line.split()[-2] for line in stages[-3:]] == ["unchanged"] * 3


def test_says_when_nothing_is_assumed(here: Path, run_egvs) -> None:
    (here / "mini" / "statics.geojson").write_text(wall("levels"))
    code, printed, error = run_egvs("compare", "mini", "--assumed-heights")
    assert (code, printed) == (0, "No height is assumed: all 2 buildings have one from the map or by hand.\n"), error
    assert not (here / "runs").exists()


def test_run_with_other_settings_has_folders_of_its_own(here: Path) -> None:
    prepared = prepare_runs(Path("mini"), ["score.gamma=3"])
    names = [height_run.folder.as_posix() for height_run in prepared.runs]
    assert names[0] == "runs/mini@gamma=3"
    assert sorted(names[1:]) == ["runs/mini@assumed_heights=0.7,gamma=3", "runs/mini@assumed_heights=1.3,gamma=3"]
    assert (prepared.buildings, prepared.assumed) == (2, 1)
    scenario = prepared.runs[1].scenario
    path = scenario.find(scenario.statics.footprints[0], "statics.footprints")
    assert json.loads(path.read_text())["features"][1]["properties"]["height_m"] == pytest.approx(4.9)


def test_rejects_other_requests(here: Path, run_egvs) -> None:
    code, _, error = run_egvs("compare", "mini", "other", "--assumed-heights")
    assert code == 2 and "--assumed-heights: expected one scenario or run, got 2" in error
    code, _, error = run_egvs("compare", "mini", "--assumed-heights", "--sensors", "VLP-16,small")
    assert code == 2 and "--assumed-heights: cannot be used together with --sensors" in error
    (here / "mini" / "statics.geojson").write_text("[]")
    with pytest.raises(InputError, match=r"statics.geojson: expected a GeoJSON FeatureCollection"):
        prepare_runs(Path("mini"))


def sensitivity(*ranks: tuple[int | None, ...]) -> list[str]:
    """Return the conclusion for sites a, b, c ... with these ranks in three runs."""
    scenario = loading.load(Path(__file__).parents[2] / "scenarios" / "demo")
    runs = tuple(HeightRun(factor, scenario, Path("runs")) for factor in (1.0, 0.7, 1.3))
    sites = [RankedAgain(name, row, (0.5,) * len(row)) for name, row in zip("abcdefgh", ranks, strict=False)]
    return list(HeightSensitivity(HeightRuns(runs, 8, 3), tuple(sites), SCORE_LABELS["egvs"]).conclusion())[1:]


def test_conclusions_in_words() -> None:
    same = [(rank, rank, rank) for rank in range(1, 6)]
    assert sensitivity(*same) == ["The best 5 sites are the same, in the same order."]
    assert sensitivity((1, 2, 1), (2, 1, 2), *same[2:]) == ["At -30 %, b is best instead of a."]
    assert sensitivity(same[0], same[1], same[2], (4, 5, 4), (5, 4, 5)) == [
        "At -30 %, the best 5 are the same in another order."
    ]
    assert sensitivity(*same[:4], (5, 5, 9), (6, 6, 5)) == ["At +30 %, e leaves the best 5, f enters them."]
    assert sensitivity(*same[:4], (5, 5, None), (6, 6, 5)) == ["At +30 %, e leaves the best 5, f enters them."]
