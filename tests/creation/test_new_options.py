"""Options of ``egvs new`` and what it leaves out: solids out of range, distance to ``--at``, poles, demand."""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path

import pytest
from shapely.geometry import LineString, MultiLineString, Point

from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.creation import assumed_traffic, building_heights, junctions, new_scenario, scenario_files
from egvs.creation.assumed_traffic import AssumedTraffic
from egvs.creation.new_scenario import NewScenario
from egvs.creation.openstreetmap import ATTRIBUTION, street_network
from egvs.creation.openstreetmap import solids as osm_solids
from egvs.formats import osm
from egvs.report import sections
from egvs.runs import run
from egvs.scenario import loading
from egvs.scenario.traffic_config import CountConfig
from egvs.traffic.capacity import Capacity, TrialRun, distribute_total
from tests.creation.new_scenarios import create_scenario
from tests.creation.test_openstreetmap import SMALL, check_sites, lanes_of, sites_of

FAR_BLOCK = (
    '<node id="1" ',
    '<node id="901" lat="52.0040" lon="9.9999"/><node id="902" lat="52.0040" lon="10.0001"/>'
    '<node id="903" lat="52.0041" lon="10.0001"/><node id="904" lat="52.0041" lon="9.9999"/>'
    '<node id="905" lat="52.0042" lon="10.0"><tag k="natural" v="tree"/></node><node id="1" ',
)
"""A block and a tree 440 m north of the junction."""

FAR_BUILDING = (
    "<relation",
    '<way id="9"><nd ref="901"/><nd ref="902"/><nd ref="903"/><nd ref="904"/><nd ref="901"/>'
    '<tag k="building" v="yes"/></way><relation',
)


@pytest.fixture(autouse=True)
def carries_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    """No trial simulations: they take longer than all the rest."""
    capacity = Capacity(1.0, (TrialRun(1.0, 100, 100, 20.0, 0),))
    monkeypatch.setattr(assumed_traffic, "find_capacity", lambda *_: capacity)


def with_far_objects(folder: Path) -> Path:
    """Write the small extract with a building and a tree far from the junction."""
    text = SMALL.read_text(encoding="utf-8")
    for anchor, replacement in (FAR_BLOCK, FAR_BUILDING):
        text = text.replace(anchor, replacement, 1)
    path = folder / "far.osm"
    path.write_text(text, encoding="utf-8")
    return path


def write_all_solids(folder: Path, extract: Path) -> None:
    """Replace the solids of a scenario by all solids of the extract."""
    read = osm.read_osm(extract)
    flags = street_network.netconvert_flags(read, lefthand=False, walk=False)
    _, streets, _ = street_network.build_network(read, extract, flags)
    mapped, counts = osm_solids.map_solids(read, streets)
    solids = building_heights.heights_from_neighbours(mapped, counts, ())
    text = scenario_files.solids_geojson(solids, counts, (ATTRIBUTION,))
    assert '"way/9"' in text
    (folder / "statics.geojson").write_text(text, encoding="utf-8")


# --- solids out of range -------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_solids_beyond_sensor_range_are_left_out_with_a_note(tmp_path: Path) -> None:
    plain = create_scenario(tmp_path / "plain", SMALL)
    summary = create_scenario(tmp_path / "far", with_far_objects(tmp_path))
    assert summary.statics.counts.dropped["out_of_range"] == {"building": 1, "tree": 1}
    assert summary.statics.counts.objects == plain.statics.counts.objects
    total = 2 + plain.statics.counts.objects.total() - plain.statics.counts.objects["tree_crown"]
    assert f"2 of {total} static objects are left out: more than 200 m (the range of a VLP-32C) from" in str(
        summary.notes
    )
    assert "left out" not in str(plain.notes)
    far, near = ((tmp_path / name / "statics.geojson").read_text() for name in ("far", "plain"))
    assert far.partition('"features"')[2] == near.partition('"features"')[2]


@pytest.mark.slow
def test_solids_out_of_range_do_not_change_scores(tmp_path: Path) -> None:
    extract = with_far_objects(tmp_path)
    create_scenario(tmp_path / "cut", extract)
    shutil.copytree(tmp_path / "cut", tmp_path / "all")
    write_all_solids(tmp_path / "all", extract)
    overrides = [
        "traffic.frames=20", "traffic.warmup_s=30", "traffic.hold='at_most'", "tpog.blocks=2", "roi.voxel_m=0.5",
        "sites.heights_m=[3]", "sites.pitch_deg=0",
    ]  # fmt: skip
    tables = {}
    for name in ("cut", "all"):
        scenario = loading.load(tmp_path / name, overrides)
        run.run(scenario, tmp_path / "runs" / name)
        tables[name] = parquet.read_artefact(tmp_path / "runs" / name / "scores.parquet", "scores")[0]
    assert tables["cut"].equals(tables["all"])
    assert max(tables["cut"].column("egvs").to_pylist()) > 0


# --- distance from --at --------------------------------------------------------------------------------------------
def print_new(summary: NewScenario, capsys: pytest.CaptureFixture[str]) -> str:
    from egvs.cli import new_summary

    capsys.readouterr()
    new_summary.print_new_scenario(summary)
    return " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_distance_from_requested_position_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    near = create_scenario(tmp_path / "near", SMALL, at=(52.0003, 10.0))
    assert near.region.from_at_m == pytest.approx(33.4 - junction_half_depth_m(near), abs=0.5)
    printed = print_new(near, capsys)
    assert f"at 52.00000,10.00000, {near.region.from_at_m:.0f} m from --at" in printed
    assert printed.count("warning:") == 1

    without = create_scenario(tmp_path / "without", SMALL)
    assert without.region.from_at_m is None
    assert "the largest of the map; --at chooses another" in print_new(without, capsys)


def junction_half_depth_m(summary: NewScenario) -> float:
    """Distance from the junction's node to its northern edge."""
    return summary.junction.area.bounds[3] - summary.junction.at_m[1]


@pytest.mark.slow
def test_junction_far_from_requested_position_is_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    far = create_scenario(tmp_path / "far", SMALL, at=(52.0008, 10.0))
    from_at_m = far.region.from_at_m
    assert from_at_m is not None and from_at_m > new_scenario.FAR_FROM_AT_M
    assert (
        f"warning: the junction ({far.junction.title}) is {from_at_m:,.0f} m from --at and may not be the one"
        in print_new(far, capsys)
    )


# --- poles every N metres ------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_poles_at_a_spacing_cover_all_kerbs(tmp_path: Path) -> None:
    default = create_scenario(tmp_path / "default", SMALL)
    dense = create_scenario(tmp_path / "dense", SMALL, pole_spacing_m=10.0)
    sparse = create_scenario(tmp_path / "sparse", SMALL, pole_spacing_m=20.0)
    assert dense.poles > default.poles == junctions.MAX_POLES
    assert 0 < sparse.poles < dense.poles
    check_sites(tmp_path / "dense", dense.poles)
    check_sites(tmp_path / "sparse", sparse.poles)

    points = [Point(float(row["x_m"]), float(row["y_m"])) for row in sites_of(tmp_path / "sparse")]
    for point in points:
        nearest_m = min(point.distance(other) for other in points if other is not point)
        assert nearest_m >= 10.0
    lanes = MultiLineString([LineString(line) for line, _ in lanes_of(tmp_path / "sparse")])
    assert max(point.distance(lanes) for point in points) < 10.0


def test_names_of_more_than_99_poles_sort_in_order() -> None:
    lines = scenario_files.sites_csv([junctions.KerbsidePole(float(i), 0.0) for i in range(100)]).splitlines()
    assert (lines[1], lines[100]) == ("k001,0.0,0.0", "k100,99.0,0.0")


EAST_M, NORTH_M = 68_677.0, 111_267.0
"""Metres of a degree of longitude and of latitude at 52 N."""


def with_poles(folder: Path, **tags_at_m: tuple[str, float, float]) -> Path:
    """Write the map with other poles: id of each (``n9001``) to its tag, metres east and metres north of the cross."""
    nodes = ""
    for name, (tag, east_m, north_m) in tags_at_m.items():
        key, _, value = tag.partition("=")
        position = f'lat="{52 + north_m / NORTH_M:.8f}" lon="{10 + east_m / EAST_M:.8f}"'
        nodes += f'<node id="{name[1:]}" {position}><tag k="{key}" v="{value}"/></node>\n'
    path = folder / "lamps.osm"
    text = re.sub(r"<node id=.600[123].*?/node>", "", SMALL.read_text())
    path.write_text(text.replace(' <node id="101"', f'{nodes} <node id="101"', 1))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("side", [1, -1], ids=["right", "left"])
def test_poles_of_the_map_are_candidates(tmp_path: Path, side: int) -> None:
    lamp = "highway=street_lamp"
    made = create_scenario(
        tmp_path / "out",
        with_poles(
            tmp_path,
            n9001=(lamp, 12, 12),
            n9002=(lamp, 32, -1.5),  # on the southern lane of the eastern street
            n9003=("highway=traffic_signals", 18, 0),  # at the stop line of vehicles from the east
            n9004=("man_made=utility_pole", -12, -12),
            n9005=("man_made=utility_pole", -12, -12.5),
            n9006=(lamp, 300, 12),  # far from the junction
            n9007=("barrier=bollard", 12, -12),
        ),
        existing_poles=True,
        lefthand=side < 0,
        righthand=side > 0,
    )
    middle_m = made.region.junction.at_m
    sites = {row["source"]: row for row in sites_of(tmp_path / "out")}
    kinds = {source: row["site"].rstrip("0123456789") for source, row in sites.items()}
    assert kinds == {"node/9001": "lamp", "node/9002": "lamp", "node/9003": "signal", "node/9004": "pole"}
    at_m = {s: (float(r["x_m"]) - middle_m[0], float(r["y_m"]) - middle_m[1]) for s, r in sites.items()}
    assert at_m["node/9001"] == pytest.approx((12, 12), abs=0.5)  # the map is turned by 0.8 degrees
    assert at_m["node/9004"] == pytest.approx((-12, -12), abs=0.5)
    lanes = MultiLineString([LineString(line) for line, _ in lanes_of(tmp_path / "out")])
    beside_m = 3.2 / 2 + junctions.KERB_M
    for name, x_m, sign in (("node/9002", 32, -1), ("node/9003", 18, side)):
        assert at_m[name][0] == pytest.approx(x_m, abs=0.5)
        assert math.copysign(1, at_m[name][1]) == sign
        point = Point(float(sites[name]["x_m"]), float(sites[name]["y_m"]))
        assert point.distance(lanes) == pytest.approx(beside_m, abs=0.05)
    assert [float(sites[f"node/900{n}"]["moved_m"]) > 1 for n in (1, 2, 3, 4)] == [False, True, True, False]
    loaded = loading.load(tmp_path / "out")
    assert set(loaded.sites.existing_poles) == {sites["node/9001"]["site"], "pole1"}
    assert any("positions of the poles other than" in entry for entry in sections.assumptions(loaded, []))
    assert any("less than 1 m from another one" in note for note in made.notes)


@pytest.mark.slow
def test_map_without_poles_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^--poles existing: no map has a street lamp, signal mast or utility pole"):
        create_scenario(tmp_path / "out", with_poles(tmp_path), existing_poles=True)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("spacing_m", [0.0, 1.5, 101.0, math.nan])
def test_rejects_spacing_of_poles(tmp_path: Path, spacing_m: float) -> None:
    with pytest.raises(InputError, match=r"--poles: expected a spacing of 2 to 100 m, got .* Use a spacing such as"):
        create_scenario(tmp_path / "out", SMALL, pole_spacing_m=spacing_m)
    assert not list(tmp_path.iterdir())


# --- demand --------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("total_per_h", [7, 600, 2001])
def test_requested_vehicles_per_hour_are_written(tmp_path: Path, total_per_h: int) -> None:
    summary = create_scenario(tmp_path / "out", SMALL, traffic=total_per_h)
    counts = loading.load(tmp_path / "out").traffic.counts
    assert sum(flow.per_hour for flow in counts) == total_per_h
    assert isinstance(summary.traffic, AssumedTraffic)
    assert summary.traffic.summary == f"carries all of the {total_per_h:,} requested vehicles an hour"
    assumed = loading.load(tmp_path / "out").assumed
    assert assumed[0] == f"shares of the movements (of {total_per_h:,} vehicles an hour)"
    assert not any("traffic" in entry for entry in assumed)


@pytest.mark.slow
def test_requested_vehicles_per_hour_above_capacity_stay_and_are_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = (TrialRun(1.0, 100, 50, 300.0, 20), TrialRun(0.5, 70, 70, 50.0, 0))
    monkeypatch.setattr(assumed_traffic, "find_capacity", lambda *_: Capacity(0.46, runs))
    summary = create_scenario(tmp_path / "out", SMALL, traffic=4000)
    assert sum(flow.per_hour for flow in summary.flows) == 4000
    note = "Traffic jams are likely: the network carries 1,840 of the 4,000 requested vehicles an hour"
    assert any(text.startswith(note) and "Lower per_hour of traffic.counts" in text for text in summary.notes)
    assert "the shares of the movements are assumed (4,000 vehicles an hour)" in print_new(summary, capsys)


def test_total_is_divided_in_proportion_by_largest_remainder() -> None:
    flows = [CountConfig(edge=name, per_hour=per_hour) for name, per_hour in (("a", 100), ("b", 50), ("c", 1))]
    assert [flow.per_hour for flow in distribute_total(flows, 20)] == [13.0, 7.0]
    assert [flow.per_hour for flow in distribute_total(flows, 302)] == [200.0, 100.0, 2.0]


@pytest.mark.parametrize("per_h", [0, -5, 100_001])
def test_rejects_number_of_vehicles_per_hour(tmp_path: Path, per_h: int) -> None:
    with pytest.raises(InputError, match=r"--vehicles-per-hour: expected 1 to 100,000 vehicles an hour, got"):
        create_scenario(tmp_path / "out", SMALL, traffic=per_h)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_command_line_takes_poles_and_demand(tmp_path: Path, run_egvs) -> None:
    folder = tmp_path / "made"
    code, printed, _ = run_egvs(
        "new", folder, "--osm", SMALL, "--poles", "every", "20m", "--vehicles-per-hour", 480
    )  # fmt: skip
    assert code == 0 and re.search(r"carries all of the 480\s+requested", printed)
    assert sum(flow.per_hour for flow in loading.load(folder).traffic.counts) == 480
    assert len(sites_of(folder)) != junctions.MAX_POLES


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--poles", "each", "20m"), "--poles: expected existing, or every and a length in metres, got 'each'"),
        (("--poles", "every", "20ft"), "--poles: expected existing, or every and a length in metres, got 'every 20ft'"),
        (("--traffic", "heavy", "--vehicles-per-hour", 9), "--traffic: cannot be combined with --vehicles-per-hour"),
    ],
)
def test_command_line_rejects_options(tmp_path: Path, run_egvs, options: tuple[object, ...], message: str) -> None:
    code, _, error = run_egvs("new", tmp_path / "made", "--osm", SMALL, *options)
    assert code == 2 and message in error
    assert not (tmp_path / "made").exists()


@pytest.mark.slow
def test_plans_of_a_new_scenario_have_one_sensor_per_pole(tmp_path: Path) -> None:
    create_scenario(tmp_path / "out", SMALL)
    assert loading.load(tmp_path / "out").placement.most_per_pole == 1


def test_errors_of_a_new_folder_name_its_final_path(tmp_path: Path) -> None:
    def reject(folder: Path) -> None:
        raise InputError(folder / "scenario.toml", f"is wrong in {folder}")

    with pytest.raises(InputError, match=rf"^{tmp_path}/made/scenario\.toml: is wrong in {tmp_path}/made"):
        scenario_files.publish_folder(tmp_path / "made", [("scenario.toml", "")], reject)
    assert not list(tmp_path.iterdir())
