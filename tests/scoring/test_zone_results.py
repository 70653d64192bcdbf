"""Road users found in zones: a case with numbers by hand, a slow twin that loops over frames, and wrong files."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely

import egvs
from egvs.artefacts import frame_boxes, readers, traffic_frames
from egvs.artefacts.readers import ZoneVisibility
from egvs.core.errors import InputError
from egvs.formats import georeference
from egvs.runs.run_context import open_folder
from egvs.scenario import loading
from egvs.scoring import zone_results, zones
from egvs.scoring.target_scores import DETECTORS
from egvs.scoring.targets import TargetRecord
from egvs.scoring.zone_results import ZoneUsers
from egvs.stages import site_scoring
from egvs.stages.site_scans import empty_scans
from egvs.traffic.network import Lane, Permission
from egvs.world.carriageway import Carriageway
from tests.conftest import collection, feature
from tests.scoring.target_scenes import GRID, frame

PEOPLE = frame_boxes.NON_VEHICLE_KINDS


def square(west: float, south: float, east: float, north: float) -> dict[str, Any]:
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    return {"type": "Polygon", "coordinates": [ring]}


def people_record() -> TargetRecord:
    """Two frames: a car that stands at x = 105, a bus that leaves x = 105 for 115, a pedestrian at 104, then 120."""
    cars = ((105.0, 205.0), (105.0, 205.0))
    buses = ((105.0, 210.0), (115.0, 210.0))
    walkers = ((104.0, 204.0), (120.0, 204.0))
    frames = []
    for number in (0, 1):
        boxes = [
            [*cars[number], 1.0, 4.0, 2.0, 1.5, 0.0],
            [*buses[number], 1.5, 12.0, 2.5, 3.0, 0.0],
            [*walkers[number], 0.9, 0.5, 0.5, 1.8, 0.0],
        ]
        frames.append(frame(boxes, ("passenger", "bus", "pedestrian"), number=number, vehicles=("c", "b", "p")))
    return TargetRecord.of(frames, GRID, PEOPLE)


def users_of(record: TargetRecord, **areas: Any) -> ZoneUsers:
    return ZoneUsers.of(record, areas, np.ones(len(record)), np.zeros(len(record), dtype=np.int64))


def test_shares_by_hand() -> None:
    """West of x = 110: the car twice, the bus and the pedestrian once. Chances are 0.5 and 0.9, 0.2, 0.4.

    All: (0.5 + 0.9 + 0.2 + 0.4) / 4 = 0.5. The car alone: 0.7. The standard error of all is that of a ratio of sums:
    residuals of the car 1.4 - 2 x 0.5 = 0.4, of the bus -0.3, of the pedestrian -0.1; 0.26 x 3 / 2 = 0.39;
    sqrt(0.39) / 4 = 0.1561.
    """
    users = users_of(people_record(), west=shapely.box(100, 200, 110, 220), nowhere=shapely.box(130, 200, 131, 201))
    seen = users.spots.visibility(np.array([30.0, 5.0, 20.0, 19.0, 9.0, 9.0]), np.array([0.5, 0.2, 0.4, 0.9, 1, 1]))
    columns = users.columns(seen)
    assert columns["zone"] == ["west"] * 4
    assert columns["class"] == ["all", "car", "bus", "pedestrian"]
    assert columns["road_users"].tolist() == [3, 1, 1, 1]
    assert columns["observations"].tolist() == [4, 2, 1, 1]
    assert columns["share_found"] == pytest.approx([0.5, 0.7, 0.2, 0.4])
    assert columns["share_found_se"][0] == pytest.approx(0.15612494995995996)
    assert all(math.isnan(error) for error in columns["share_found_se"][1:])
    assert columns["with_points"].tolist() == [2, 1, 0, 1]
    assert users.empty == ("nowhere",)
    (warning,) = users.warn_empty()
    assert "no road user has its centre in nowhere in the 2 frames examined" in str(warning)


def test_sidewalk_zones_without_pedestrians_give_no_warning() -> None:
    """The lane leads along y = 205 from x = 100 to 140: through the zone ahead, not over the sidewalk at y = 215.

    The car and the bus are at x = 105 to 115. With a pedestrian anywhere, both empty zones are a warning.
    """
    lane = Lane("100,205 140,205", "lane", None, 40.0, Permission(None, frozenset()))
    carriageway = Carriageway(("lane_0",), (lane,))
    record = people_record()
    empty = {"ahead": shapely.box(125, 203, 135, 207), "north sidewalk": shapely.box(100, 214, 140, 216)}

    def users(record: TargetRecord, carriageway: Carriageway | None) -> ZoneUsers:
        rows = np.ones(len(record)), np.zeros(len(record), dtype=np.int64)
        return ZoneUsers.of(record, empty, *rows, carriageway)

    with_people = users(record, carriageway)
    assert with_people.for_pedestrians == () and "ahead, north sidewalk" in str(next(with_people.warn_empty()))
    cars = frame([[105.0, 205.0, 1.0, 4.0, 2.0, 1.5, 0.0]], ("passenger",), vehicles=("c",))
    without_people = users(TargetRecord.of([cars], GRID, PEOPLE), carriageway)
    (warning,) = without_people.warn_empty()
    assert "no road user has its centre in ahead in the 1 frame examined" in str(warning)
    assert without_people.describe_for_pedestrians() == (
        "no results for 1 zone beside the lanes, since the traffic has no pedestrians"
        " ([effects.pedestrians_bicycles]): north sidewalk"
    )
    assert users(TargetRecord.of([cars], GRID, PEOPLE), None).for_pedestrians == ()
    recorded = replace(without_people, is_recorded=True)
    assert "no pedestrians were recorded" in recorded.describe_for_pedestrians()
    assert "[effects" not in str(next(recorded.warn_empty()))


def test_sensors_together_miss_what_both_miss(monkeypatch: pytest.MonkeyPatch) -> None:
    """Chances 0.5 and 0.6 give 1 - 0.5 x 0.4 = 0.8."""
    record = people_record()
    users = users_of(record, west=shapely.box(100, 200, 110, 220))

    class Seen:
        def __init__(self, chance: float) -> None:
            self.points, self.chance = np.full(len(record), 12.0), chance

    monkeypatch.setattr(zone_results, "detection_probabilities", lambda seen, _: np.full(len(record), seen.chance))
    both = users.together([Seen(0.5), Seen(0.6)])  # type: ignore[list-item]
    assert both.share == pytest.approx([0.8] * 4)
    assert both.with_points.tolist() == [4, 2, 1, 1]


def test_centre_on_the_edge_is_inside() -> None:
    users = users_of(people_record(), edge=shapely.box(105, 200, 106, 220))
    assert users.columns(users.spots.visibility(np.zeros(6), np.zeros(6)))["class"] == ["all", "car", "bus"]


def test_every_vclass_has_one_class() -> None:
    kinds = [kind for kinds in zone_results.CLASSES.values() for kind in kinds]
    assert len(kinds) == len(set(kinds))
    assert zone_results.road_user_class("motorcycle") == "two-wheeler"
    assert zone_results.road_user_class("drone") == "other"


ZONES = (("west", (0, -10, 20, 10)), ("lane", (0, -4, 40, 0)), ("far", (38, 5, 40, 10)))


@pytest.fixture
def scored(mini: Path, tmp_path: Path) -> tuple[egvs.Scenario, Path]:
    features = [feature(square(*corners), name=name) for name, corners in ZONES]
    (mini / "zones.geojson").write_text(collection(*features))
    scenario = loading.load(mini, ["score.zones='zones.geojson'", "score.rank_by='expected_detections'"])
    egvs.run(scenario, tmp_path / "run", jobs=1)
    return scenario, tmp_path / "run"


def test_table_equals_a_loop_over_frames(scored: tuple[egvs.Scenario, Path]) -> None:
    scenario, out = scored
    context = open_folder(scenario, out, jobs=1)
    targets = site_scoring.SiteScoring(context).targets
    assert targets is not None
    expected = {}
    for scan in empty_scans(context):
        visible = targets.visible(scan.beams)
        chances = zone_results.detection_probabilities(visible, DETECTORS)
        row = 0
        found = defaultdict(list)
        for recorded in traffic_frames.read_frames(out / "trajectories.parquet", np.arange(40)):
            for i in recorded.target_rows(scenario.roi.grid.roi):
                point = shapely.Point(recorded.boxes[i, :2])
                for name, corners in ZONES:
                    if shapely.box(*corners).covers(point):
                        found[name].append((recorded.vehicles[i], chances[row]))
                row += 1
        for name, pairs in found.items():
            mean = math.fsum(chance for _, chance in pairs) / len(pairs)
            vehicles = sorted({vehicle for vehicle, _ in pairs})
            residuals = [math.fsum(chance - mean for v, chance in pairs if v == vehicle) for vehicle in vehicles]
            error = math.nan
            if len(vehicles) > 1:
                error = math.sqrt(math.fsum(r * r for r in residuals) * len(vehicles) / (len(vehicles) - 1)) / len(
                    pairs
                )
            expected[scan.site.name, name] = (len(vehicles), len(pairs), mean, error)

    rows = pq.read_table(out / "zones.parquet").to_pylist()
    table = {(row["site"], row["zone"]): row for row in rows if row["class"] == "all"}
    assert table.keys() == expected.keys()
    assert ("pole_a", "far") not in expected
    for key, (vehicles, observations, mean, error) in expected.items():
        assert (table[key]["road_users"], table[key]["observations"]) == (vehicles, observations)
        assert table[key]["share_found"] == pytest.approx(mean, abs=1e-12)
        assert table[key]["share_found_se"] == pytest.approx(error, abs=1e-12, nan_ok=True)


@pytest.mark.slow
def test_without_zones_all_other_artefacts_are_the_same(scored: tuple[egvs.Scenario, Path], tmp_path: Path) -> None:
    scenario, out = scored
    plain = loading.load(scenario.folder, ["score.rank_by='expected_detections'"])
    egvs.run(plain, tmp_path / "plain", jobs=1)
    assert not (tmp_path / "plain" / "zones.parquet").exists()
    for name in ("scores.parquet", "blindspots.parquet"):
        with_zones, without = (pq.read_table(folder / name) for folder in (out, tmp_path / "plain"))
        assert repr(with_zones.to_pydict()) == repr(without.to_pydict())  # NaN equals NaN here
    egvs.run(plain, out, jobs=1)
    assert not (out / "zones.parquet").exists()
    for name in ("scores.parquet", "blindspots.parquet"):
        assert (out / name).read_bytes() == (tmp_path / "plain" / name).read_bytes()


@pytest.mark.slow
def test_table_has_the_areas(scored: tuple[egvs.Scenario, Path]) -> None:
    areas = readers.read_zone_areas(scored[1] / "zones.parquet")
    assert [(name, area.bounds) for name, area in areas.items()] == list(ZONES)


@pytest.mark.slow
def test_report_shows_the_zones_of_the_best_site(scored: tuple[egvs.Scenario, Path]) -> None:
    page = (scored[1] / "report.html").read_text().replace("\u00a0", " ")
    rows = readers.read_zones(scored[1] / "zones.parquet", "pole_b")
    section = page[page.index('<section id="zones">') :]
    assert "from pole_b, the best site" in section
    for row in rows:
        assert f">{row.zone}</th>" in section
        assert row.share_text in section
    assert ">far</th>" not in section


@pytest.mark.slow
def test_editing_the_file_scores_again(scored: tuple[egvs.Scenario, Path]) -> None:
    scenario, out = scored
    before = pq.read_table(out / "zones.parquet").to_pylist()
    (scenario.folder / "zones.geojson").write_text(collection(feature(square(0, 0, 40, 4), name="north")))
    egvs.run(scenario, out, jobs=1)
    after = pq.read_table(out / "zones.parquet").to_pylist()
    assert {row["zone"] for row in before} == {"west", "lane"}
    assert {row["zone"] for row in after} == {"north"}


def test_worst_zones_of_each_group() -> None:
    rows = [
        ZoneVisibility("a", "all", 99, 99, 0.1, 0.01),
        ZoneVisibility("a", "pedestrian", 30, 90, 0.71, 0.03),
        ZoneVisibility("b", "pedestrian", 30, 90, 0.80, 0.03),
        ZoneVisibility("c", "pedestrian", 9, 90, 0.20, 0.03),
        ZoneVisibility("a", "car", 30, 90, 0.90, 0.03),
        ZoneVisibility("b", "bus", 30, 90, 0.85, 0.03),
    ]
    worst = readers.worst_zones(rows)
    assert [(row.zone, row.user_class) for row in worst] == [("a", "pedestrian"), ("b", "bus")]
    assert worst[0].in_words() == "a, 71 ± 3 % of 30 pedestrians"
    assert readers.describe_worst_zones("the plan", worst[:1]) == (
        "Of all zones and classes of road users, the plan finds the smallest shares in: a, 71 ± 3 % of 30 pedestrians"
    )


BOW_TIE = {"type": "Polygon", "coordinates": [[[0, 0], [9, 9], [9, 0], [0, 9], [0, 0]]]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (collection(feature(BOW_TIE, name="x")), "feature 0 (x): geometry: "),
        (collection(feature(square(0, 0, 5, 5))), "feature 0: expected the property name, got none"),
        (collection(feature(square(60, 0, 65, 5), name="x")), "zone x: expected an area in the region of interest"),
        (collection(), "expected at least one area, got none"),
        (
            collection(feature(square(11.57, 48.13, 11.5701, 48.1301), name="x")),
            "look like degrees",
        ),
    ],
)  # fmt: skip
def test_wrong_file_is_one_message(mini: Path, text: str, message: str) -> None:
    (mini / "zones.geojson").write_text(text)
    with pytest.raises(InputError) as error:
        zones.reported_zones(loading.load(mini, ["score.zones='zones.geojson'"]))
    assert message in str(error.value)


def test_zone_in_degrees_of_a_scenario_with_a_reference_system(mini: Path) -> None:
    frame_of_world = georeference.WorldFrame.from_projection("EPSG:25832", (-500000.0, -5600000.0), "test")
    corners = np.array([[0, 0], [9, 0], [9, 5], [0, 5], [0, 0]], dtype=np.float64)
    ring = frame_of_world.to_degrees(corners).tolist()
    polygon = {"type": "Polygon", "coordinates": [ring]}
    (mini / "zones.geojson").write_text(collection(feature(polygon, name="x"), crs=georeference.WGS84))
    keys = ["score.zones='zones.geojson'", "crs.epsg=25832", "crs.offset_m=[-500000, -5600000]"]
    area = zones.reported_zones(loading.load(mini, keys))["x"]
    assert area.symmetric_difference(shapely.Polygon(corners)).area < 0.01


def test_zones_that_reach_out_of_the_region_are_a_warning(mini: Path) -> None:
    """Of 40 m, 30 are east of the region: three quarters."""
    scenario = loading.load(mini, ["score.zones='zones.geojson'"])
    (west_m, south_m), (east_m, _) = zones.region_bounds_m(scenario)
    inside = square(west_m, south_m, west_m + 4.0, south_m + 4.0)
    partly = square(east_m - 10.0, south_m, east_m + 30.0, south_m + 4.0)
    path = mini / "zones.geojson"
    path.write_text(collection(feature(inside, name="inside"), feature(partly, name="partly")))
    (warning,) = zones.warn_partly_outside(scenario)
    assert "75 % of partly" in str(warning) and "of inside" not in str(warning)
    path.write_text(collection(feature(inside, name="inside")))
    assert not list(zones.warn_partly_outside(scenario))


def test_degrees_declared_without_reference_system_are_refused(mini: Path) -> None:
    document = json.loads(collection(feature(square(11.57, 48.13, 11.58, 48.14), name="x")))
    del document["crs"]  # degrees, as GeoJSON says
    (mini / "zones.geojson").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"zones\.geojson"):
        zones.reported_zones(loading.load(mini, ["score.zones='zones.geojson'"]))
