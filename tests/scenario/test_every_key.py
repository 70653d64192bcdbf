"""Every key of a scenario has an effect: another value changes a stage key, the sites, or the plan of a study.

Evidence: the keys are read from the models of the scenario, so that a new key without a row here fails. Each row names
a scenario (as overrides of the small one) in which the key must have an effect, and another legal value.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, get_args

import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel

import egvs
from egvs.clouds import simulation as cloud_simulation
from egvs.core.errors import InputError
from egvs.placement.plan import solve_placement
from egvs.runs import stage_keys
from egvs.runs.run_context import open_folder
from egvs.scenario.loading import load, scenario_from_dict
from egvs.scenario.model import Scenario
from egvs.stages.inputs import Inputs
from egvs.studies import what_if
from tests.conftest import SCENARIO, SITES, collection, feature, write_mini
from tests.installed import needs

pytestmark = [pytest.mark.system, needs("tracks")]  # the version of SUMO is part of a stage key

EXCEPTIONS = {
    "extends": "cannot be set on the command line; tests/scenario/test_loading.py shows what it takes over",
    "sensors.*.range_sigma_m": "it is in point clouds only; see tests/clouds/test_simulation.py",
}
"""Keys that this test leaves out, each with the reason."""

STAGES = ("statics", "traffic", "tpog", "scan", "score", "report")
"""Stages with results; the key of the check covers nearly all settings, and would hide a key without effect."""


class Change(NamedTuple):
    """Another value of a key, as TOML, and overrides of a scenario file that let the key have an effect."""

    value: str
    base: tuple[str, ...] = ()
    file: str = "scenario.toml"
    together_with: str = ""


NETWORK = ("traffic.network='streets.net.xml'",)
COUNTED = (*NETWORK, "traffic.counts=[{edge='a', per_hour=100}]")
TURNS = (*NETWORK, "traffic.counts=[{from_edge='a', to_edge='b', per_hour=100}]")
HALVES = ("traffic.periods=[{name='a', length_s=12}, {name='b', begin_s=12, length_s=8}]",)
SIGNALS = (*NETWORK, "traffic.signals.a={phases=[{green={north=['all']}, green_s=30}]}")
ACTUATED = (*SIGNALS, "traffic.signals.a.type='actuated'")
PERIOD_COUNTS = (*NETWORK, "traffic.periods=[{name='a', counts=[{edge='a', per_hour=100}]}]")
PERIOD_TURNS = (*NETWORK, "traffic.periods=[{name='a', counts=[{from_edge='a', to_edge='b', per_hour=100}]}]")
TRACKED = ("traffic.tracks=['tracks.csv']", "traffic.track_crs='world'")
MAPPED = (
    "traffic.tracks=['own.csv']",
    "traffic.track_columns={time='t', id='id', x='x', y='y', z='z', yaw='a', length='l', width='w', height='h',"
    " type='type', default_type='car'}",
)
PERIODS = (*NETWORK, "traffic.periods=[{name='a'}, {name='b'}]")
POLYGONS = ("statics.polygons=['solids.poly.xml']",)
MESH = ("statics.meshes=[{file='box.ply'}]",)
GRID = ("sites.grid={low_m=[2, -9], high_m=[38, -9], spacing_m=9, heights_m=[3]}",)
ALONG = ("sites.along=[{line_m=[[2, -9], [38, -9]], spacing_m=9, heights_m=[3]}]",)
NO_HEIGHT = ("sites.file='places.csv'", "sites.heights_m=[3]")
TABLE = ("sensors.small={beams='beams.csv', range_m=90}",)
EVEN = ("kind='even'", "samples=99", "azimuth_deg=[-60, 60]", "elevation_deg=[-20, 5]")
DIRECTIONS = ("kind='file'", "samples=99", "file='directions.csv'")
TURNING = "sensors.small.pattern.turns=[3.1, -5.3]"
ROSETTE = ("kind='rosette'", "samples=99", "azimuth_deg=[-60, 60]", "elevation_deg=[-20, 5]", "turns=[3.1, -5.3]")


def pattern(keys: tuple[str, ...]) -> tuple[str, ...]:
    return (f"sensors.small={{range_m=90, pattern={{{', '.join(keys)}}}}}",)


def effect(name: str, parameters: str = "") -> tuple[str, ...]:
    return (f"effects.{name}={{{parameters}}}",)


TRACKS = """track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,psi_rad,length,width
1,0,0,car,2,2.5,0,10,0,4,1.8
1,1,60000,car,12,2.5,0,10,0,4,1.8
"""

NAMES = {
    "sensors": "small",
    "traffic.signals": "a",
    "articulated.kinds": "car",
    "weights.zones": "crossing",
    "placement.zones": "crossing",
    "what_if": "works",
}
"""Names in tables of tables."""

BUS = effect("articulated", "kinds={car={parts_m=[2, 2.5], hinges_m=[2], axles_m=[1.5]}}")
WEIGHTED = ("score.weights.zones.crossing={polygon_m=[[0, 0], [5, 0], [5, 5]], weight=2}",)
WALKERS = (*NETWORK, "effects.pedestrians_bicycles={pedestrians_per_h=9, bicycles_per_h=9}")
ONE, TWO, FIVE = (("sites.file='five.csv'", f"placement.count={count}") for count in (1, 2, 5))
COVERED = (*TWO, "placement.zones.crossing={polygon_m=[[5, -8], [12, -8], [12, 8], [5, 8]], share=0.05}")
WEIGHTED_BY_FILE = ("score.weights.zones.crossing={file='zones.csv', weight=2}",)
COVERED_BY_FILE = (*TWO, "placement.zones.crossing={file='zones.csv', share=0.05}")
BUDGET = ("sites.file='five.csv'", "costs.pole=10", "costs.sensor={small=10}", "placement.budget=45")
WHAT_IF = ("what_if.works={share=0.5, boxes=[{x_m=1, y_m=9, length_m=2, width_m=1, height_m=3}]}",)
GROWN = ("what_if.works={share=0.5, tree_scale=2}", "statics.footprints=['trees.geojson']")
REFINED = (*ONE, "placement.refine={radius_m=1, evaluations=100}")

KEYS: dict[str, Change] = {
    "name": Change("'renamed'"),
    "description": Change("'changed'"),
    "assumed": Change("['the poles']"),
    "seed": Change("8"),
    "crs.epsg": Change("25833", ("crs.epsg=25832",)),
    "crs.offset_m": Change("[-500000, -5000000]", ("crs.epsg=25832",)),
    "crs.zero_height_m": Change("5"),
    "roi.center_m": Change("[20, 0, 3]"),
    "roi.size_m": Change("[40, 20, 4]"),
    "roi.voxel_m": Change("1"),
    "traffic.network": Change("'others.net.xml'", NETWORK),
    "traffic.routes": Change("['trips.rou.xml']", file="without_kinds.toml"),
    "traffic.sumocfg": Change("'streets.sumocfg'", file="without_kinds.toml"),
    "traffic.seeds": Change("2", NETWORK),
    "traffic.fcd": Change("'others.csv'"),
    "traffic.fcd_geo": Change("true"),
    "traffic.tracks": Change("['other_tracks.csv']", TRACKED),
    "traffic.pedestrian_tracks": Change("['tracks.csv']", NETWORK, "without_kinds.toml"),
    "traffic.track_gap_s": Change("3", TRACKED),
    "traffic.track_crs": Change("'EPSG:25832'", TRACKED),
    "traffic.coverage": Change("'others.geojson'", TRACKED),
    **{
        f"traffic.track_columns.{key}": Change(value, MAPPED)
        for key, value in {
            "time": "'s'", "id": "'type'", "x": "'a'", "y": "'a'", "z": "'a'", "yaw": "'l'", "length": "'w'",
            "width": "'l'", "height": "'l'", "type": "'id'", "types": "{PKW='car'}", "default_type": "'bus'",
            "delimiter": "';'", "time_unit": "'ms'", "length_unit": "'ft'", "yaw_unit": "'deg'",
            "yaw_convention": "'cw_from_north'", "reference": "'front'", "z_reference": "'bottom'",
            "crs": "'EPSG:25832'",
        }.items()
    },
    "traffic.roads": Change("'streets.net.xml'"),
    "traffic.vtypes": Change("['sizes.add.xml']"),
    "traffic.vehicles": Change("20", NETWORK),
    "traffic.vehicles_per_lane_km": Change("5", NETWORK),
    "traffic.vehicles_per_h": Change("500", NETWORK),
    "traffic.hold": Change("'at_most'", (*NETWORK, "traffic.vehicles=20")),
    "traffic.frames": Change("20"),
    "traffic.frame_period_s": Change("1"),
    "traffic.begin_s": Change("1"),
    "traffic.step_s": Change("0.5", NETWORK),
    "traffic.warmup_s": Change("1"),
    "traffic.lateral_resolution_m": Change("0", NETWORK),
    "traffic.junction_blocker_s": Change("10", NETWORK),
    "traffic.teleport_s": Change("60", NETWORK),
    "traffic.trips_per_s": Change("1", NETWORK),
    "traffic.max_depart_delay_s": Change("60", NETWORK),
    "traffic.reroute_at_departure": Change("true", NETWORK),
    "traffic.redraw_departures": Change("true", ("traffic.routes=['trips.rou.xml']",), file="without_kinds.toml"),
    "traffic.min_trip_m": Change("10", NETWORK),
    "traffic.edge_weights": Change("{a=2}", NETWORK),
    "traffic.signals.*.file": Change("'plan.csv'", (*NETWORK, "traffic.signals.a={file='trips.rou.xml'}")),
    "traffic.signals.*.type": Change("'actuated'", SIGNALS),
    "traffic.signals.*.cycle_s": Change("35", SIGNALS),
    "traffic.signals.*.offset_s": Change("5", SIGNALS),
    "traffic.signals.*.yellow_s": Change("4", SIGNALS),
    "traffic.signals.*.all_red_s": Change("1", SIGNALS),
    "traffic.signals.*.phases.*.green": Change("{south=['left']}", SIGNALS),
    "traffic.signals.*.phases.*.green_s": Change("40", SIGNALS),
    "traffic.signals.*.phases.*.yellow_s": Change("4", SIGNALS),
    "traffic.signals.*.phases.*.all_red_s": Change("1", SIGNALS),
    "traffic.signals.*.phases.*.min_green_s": Change("8", ACTUATED),
    "traffic.signals.*.phases.*.max_green_s": Change("60", ACTUATED),
    "traffic.counts.*.edge": Change("'b'", COUNTED),
    "traffic.counts.*.from_edge": Change("'c'", TURNS),
    "traffic.counts.*.to_edge": Change("'c'", TURNS),
    "traffic.counts.*.per_hour": Change("200", COUNTED),
    "traffic.observed": Change("'observed.csv'", COUNTED),
    "traffic.counts.*.kind": Change("'car'", COUNTED),
    "traffic.kinds.*.name": Change("'other'"),
    "traffic.kinds.*.vclass": Change("'bus'"),
    "traffic.kinds.*.share": Change("2", NETWORK),
    "traffic.kinds.*.length_m": Change("5"),
    "traffic.kinds.*.width_m": Change("2"),
    "traffic.kinds.*.height_m": Change("2"),
    "traffic.kinds.*.attributes": Change("{sigma=0.2}", NETWORK),
    "traffic.periods.*.name": Change("'c'", HALVES),
    "traffic.periods.*.weight": Change("2", HALVES),
    "traffic.periods.*.sumocfg": Change("'streets.sumocfg'", PERIODS),
    "traffic.periods.*.fcd": Change("'others.csv'", HALVES),
    "traffic.periods.*.tracks": Change("['tracks.csv']", HALVES),
    "traffic.periods.*.routes": Change("['trips.rou.xml']", PERIODS),
    "traffic.periods.*.vehicles": Change("20", PERIODS),
    "traffic.periods.*.begin_s": Change("1", HALVES),
    "traffic.periods.*.length_s": Change("8", HALVES),
    "traffic.periods.*.counts.*.edge": Change("'b'", PERIOD_COUNTS),
    "traffic.periods.*.counts.*.from_edge": Change("'c'", PERIOD_TURNS),
    "traffic.periods.*.counts.*.to_edge": Change("'c'", PERIOD_TURNS),
    "traffic.periods.*.counts.*.per_hour": Change("200", PERIOD_COUNTS),
    "traffic.periods.*.counts.*.kind": Change("'car'", PERIOD_COUNTS),
    "statics.footprints": Change("['others.geojson']"),
    "statics.polygons": Change("['solids.poly.xml']"),
    "statics.polygon_height_m": Change("4", POLYGONS),
    "statics.polygon_types": Change("{building='ignore'}", POLYGONS),
    "statics.meshes.*.file": Change("'other_box.ply'", MESH),
    "statics.meshes.*.offset_m": Change("[1, 0, 0]", MESH),
    "statics.meshes.*.epsg": Change("25833", ("crs.epsg=25832", *MESH)),
    "statics.meshes.*.origin_deg": Change("[9, 50]", ("crs.epsg=25832", *MESH)),
    "statics.meshes.*.kind": Change("'kiosk'", MESH),
    "statics.ground": Change("false"),
    "statics.terrain": Change("'other_box.ply'", (*NETWORK, "statics.terrain='box.ply'")),
    "tpog.blocks": Change("2"),
    "sites.file": Change("'five.csv'"),
    "sites.grid.low_m": Change("[3, -9]", GRID),
    "sites.grid.high_m": Change("[38, 9]", GRID),
    "sites.grid.spacing_m": Change("6", GRID),
    "sites.grid.heights_m": Change("[4]", GRID),
    "sites.along.*.line_m": Change("[[3, -9], [38, -9]]", ALONG),
    "sites.along.*.spacing_m": Change("6", ALONG),
    "sites.along.*.heights_m": Change("[4]", ALONG),
    "sites.only_free": Change("false", ("sites.along=[{line_m=[[16, 6], [38, 6]], spacing_m=9, heights_m=[3]}]",)),
    "sites.points": Change("'scan.ply'", ("sites.file='one.csv'",)),
    "sites.sensor": Change("'VLP-16'"),
    "sites.replace_sensor": Change("'VLP-16'", ("sites.file='sensors.csv'",)),
    "sites.heights_m": Change("[4]", NO_HEIGHT),
    "sites.aim": Change("'roi'"),
    "sites.aim_m": Change("[20, 0]"),
    "sites.yaw_deg": Change("90"),
    "sites.pitch_deg": Change("-10"),
    "sites.roll_deg": Change("5"),
    "sites.mount": Change("'inverted'"),
    "sites.existing_poles": Change("'all'", BUDGET),
    "sensors.*.elevations_deg": Change("[-20, 5]"),
    "sensors.*.channels": Change("4"),
    "sensors.*.azimuth_offsets_deg": Change("[0, 1, 0, 1, 0, 1, 0, 1]"),
    "sensors.*.azimuth_step_deg": Change("2"),
    "sensors.*.azimuth_deg": Change("[-60, 60]"),
    "sensors.*.beams": Change("'other_beams.csv'", TABLE),
    "sensors.*.pattern.kind": Change("'rosette'", pattern(EVEN), together_with=TURNING),
    "sensors.*.pattern.file": Change("'other_directions.csv'", pattern(DIRECTIONS)),
    "sensors.*.pattern.samples": Change("50", pattern(EVEN)),
    "sensors.*.pattern.azimuth_deg": Change("[-60, 50]", pattern(EVEN)),
    "sensors.*.pattern.elevation_deg": Change("[-20, 0]", pattern(EVEN)),
    "sensors.*.pattern.turns": Change("[4.1, -5.3]", pattern(ROSETTE)),
    "sensors.*.range_m": Change("50"),
    "sensors.*.wavelength_nm": Change("1550", effect("fog", "visibility_m=100")),
    "sensors.*.divergence_mrad": Change("[1, 1]", effect("divergence")),
    "sensors.*.rated_range_m": Change("80", effect("range_limit")),
    "sensors.*.rated_reflectivity": Change("0.1", (*effect("range_limit"), "sensors.small.rated_range_m=80")),
    "sensors.*.mount": Change("'inverted'"),
    "sensors.*.softness": Change("0.5", (*effect("range_limit"), "sensors.small.rated_range_m=80")),
    "sensors.*.dropout": Change("0.2", (*effect("range_limit"), "sensors.small.rated_range_m=80")),
    "scan.keep": Change("false"),
    "score.gamma": Change("3"),
    "score.rank_by": Change("'coverage'"),
    "score.others": Change("['coverage']"),
    "score.detector": Change("'cluster'"),
    "score.weights.kinds": Change("{bus=2}"),
    "score.weights.zones.*.polygon_m": Change("[[0, 0], [9, 0], [9, 9]]", WEIGHTED),
    "score.weights.zones.*.file": Change("'other_zones.csv'", WEIGHTED_BY_FILE),
    "score.weights.zones.*.weight": Change("3", WEIGHTED),
    "score.zones": Change("'other_zones.csv'", ("score.zones='zones.csv'",)),
    "score.keep_visibility": Change("'all'"),
    "score.blindspots": Change("false"),
    "score.standard_error": Change("false"),
    "score.sampled_frames": Change("20"),
    "effects.range_limit.reflectivity": Change("0.5", effect("range_limit")),
    "effects.range_limit.incidence_deg": Change("20", effect("range_limit")),
    "effects.range_limit.softness": Change("0.1", effect("range_limit")),
    "effects.range_limit.dropout": Change("0.2", effect("range_limit")),
    "effects.range_limit.rated_range_m": Change("80", effect("range_limit")),
    "effects.range_limit.rated_reflectivity": Change("0.5", effect("range_limit")),
    "effects.rain.rate_mm_h": Change("30", effect("rain", "rate_mm_h=20")),
    "effects.rain.law": Change("'france'", effect("rain", "rate_mm_h=20")),
    "effects.fog.visibility_m": Change("50", effect("fog", "visibility_m=100")),
    "effects.fog.model": Change("'kruse'", effect("fog", "visibility_m=100")),
    "effects.fog.contrast": Change("0.05", effect("fog", "visibility_m=100")),
    "effects.dropout.share": Change("0.5", effect("dropout", "share=0.2")),
    "effects.surface_losses.grazing_loss": Change("0.5", effect("surface_losses")),
    "effects.surface_losses.grazing_deg": Change("80", effect("surface_losses")),
    "effects.surface_losses.grazing_width_deg": Change("1", effect("surface_losses")),
    "effects.surface_losses.dark_share": Change("0.5", effect("surface_losses")),
    "effects.surface_losses.dark_loss": Change("0.5", effect("surface_losses")),
    "effects.surface_losses.glass_loss": Change("0.5", effect("surface_losses")),
    "effects.range_noise.footprint_mrad": Change("0.5", effect("range_noise")),
    "effects.range_noise.max_sigma_m": Change("0.5", effect("range_noise")),
    "effects.moving_occlusion.method": Change("'independent'", effect("moving_occlusion")),
    "effects.moving_occlusion.frames": Change("20", effect("moving_occlusion")),
    "effects.divergence.sub_beams": Change("19", effect("divergence")),
    "effects.divergence.divergence_mrad": Change("[1, 1]", effect("divergence")),
    "effects.mixed_returns.pulse_ns": Change("10", effect("mixed_returns")),
    "effects.mixed_returns.returns": Change("'first'", effect("mixed_returns")),
    "effects.mixed_returns.sub_beams": Change("19", effect("mixed_returns")),
    "effects.mixed_returns.divergence_mrad": Change("[1, 1]", effect("mixed_returns")),
    "effects.mount_sway.tilt_deg": Change("2", effect("mount_sway", "tilt_deg=1")),
    "effects.mount_sway.samples": Change("9", effect("mount_sway", "tilt_deg=1")),
    "effects.foliage.leaf_area_density": Change("2", effect("foliage")),
    "effects.foliage.season": Change("'winter'", effect("foliage")),
    "effects.foliage.projection": Change("0.4", effect("foliage")),
    "effects.foliage.step_m": Change("1", effect("foliage")),
    "effects.pedestrians_bicycles.pedestrians_per_h": Change("100", WALKERS),
    "effects.pedestrians_bicycles.bicycles_per_h": Change("100", WALKERS),
    "effects.pedestrians_bicycles.pedestrian_m": Change("[1, 1, 2]", WALKERS),
    "effects.pedestrians_bicycles.bicycle_m": Change("[1, 1, 2]", WALKERS),
    "effects.articulated.kinds.*.parts_m": Change("[2.5, 2]", BUS),
    "effects.articulated.kinds.*.hinges_m": Change("[2.2]", BUS),
    "effects.articulated.kinds.*.axles_m": Change("[1.2]", BUS),
    "effects.articulated.auto": Change("false", BUS),
    "effects.slope": Change("{}", NETWORK),
    "costs.sensor": Change("{small=30}", BUDGET),
    "costs.pole": Change("30", BUDGET),
    "costs.metre": Change("5", BUDGET),
    "placement.count": Change("2", ONE),
    "placement.budget": Change("90", BUDGET),
    "placement.reach": Change("1", ("sites.file='five.csv'", "placement.reach=0.5")),
    "placement.forced": Change("['d', 'c']", TWO),
    "placement.excluded": Change("['pole_a', 'pole_b', 'b_high']", TWO),
    "placement.most_per_pole": Change("1", FIVE),
    "placement.least_distance_m": Change("15", FIVE),
    "placement.zones.*.polygon_m": Change("[[20, -8], [30, -8], [30, 8]]", COVERED),
    "placement.zones.*.file": Change("'other_zones.csv'", COVERED_BY_FILE),
    "placement.zones.*.share": Change("0.02", COVERED),
    "placement.zones.*.by": Change("2", COVERED),
    "placement.objective": Change("'worst'", (*HALVES, *TWO)),
    "placement.periods": Change("['b']", (*HALVES, *TWO, "placement.objective='worst'")),
    "placement.survives": Change("1", TWO),
    "placement.refine.radius_m": Change("4", REFINED),
    "placement.refine.within_m": Change("[[[0, -14], [40, -14], [40, 14], [0, 14]]]", REFINED),
    "placement.refine.heights_m": Change("[2, 12]", REFINED),
    "placement.refine.yaw_deg": Change("[0, 0.4]", REFINED),
    "placement.refine.pitch_deg": Change("[-30, 0]", REFINED),
    "placement.refine.roll_deg": Change("[-9, 9]", REFINED),
    "placement.refine.evaluations": Change("50", REFINED),
    "validation.bodies": Change("{sedan='box.ply'}"),
    "what_if.*.share": Change("0.3", WHAT_IF),
    "what_if.*.vehicles": Change("'parked.csv'", WHAT_IF),
    "what_if.*.footprints": Change("['others.geojson']", WHAT_IF),
    "what_if.*.boxes.*.x_m": Change("5", WHAT_IF),
    "what_if.*.boxes.*.y_m": Change("5", WHAT_IF),
    "what_if.*.boxes.*.yaw_deg": Change("5", WHAT_IF),
    "what_if.*.boxes.*.length_m": Change("5", WHAT_IF),
    "what_if.*.boxes.*.width_m": Change("5", WHAT_IF),
    "what_if.*.boxes.*.height_m": Change("5", WHAT_IF),
    "what_if.*.boxes.*.kind": Change("'container'", WHAT_IF),
    "what_if.*.tree_scale": Change("1.5", GROWN),
}  # fmt: skip


def scenario_keys(model: type[BaseModel] = Scenario, prefix: str = "") -> Iterator[str]:
    """Every key with its tables; ``*`` stands for a row of a list, or a name in a table."""
    for name, field in model.model_fields.items():
        tables = list(tables_in(field.annotation))
        if not tables or not tables[0][0].model_fields:
            yield prefix + name
        for table, separator in tables:
            yield from scenario_keys(table, f"{prefix}{name}{separator}")


def tables_in(annotation: Any, separator: str = ".") -> Iterator[tuple[type[BaseModel], str]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation, separator
        return
    is_container = getattr(annotation, "__origin__", None) in (tuple, dict)
    for argument in get_args(annotation):
        yield from tables_in(argument, ".*." if is_container else separator)


def test_every_key_of_the_scenario_has_a_row_or_a_reason() -> None:
    keys = list(scenario_keys())
    assert sorted(keys) == sorted([*KEYS, *EXCEPTIONS])
    assert len(keys) > 150


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the small scenario, with further inputs and the runs of both kinds of traffic."""
    import trimesh

    folder = write_mini(tmp_path_factory.mktemp("every_key") / "mini")
    fcd = (folder / "fcd.csv").read_text()
    house = {"type": "Polygon", "coordinates": [[[14, 5], [17, 5], [17, 8], [14, 5]]]}
    texts = {
        "streets.net.xml": "<net/>",
        "others.net.xml": "<net> </net>",
        "observed.csv": "approach,queue_m\nN,40\n",
        "trips.rou.xml": "<routes/>",
        "plan.csv": "phase,approach,movement,green_s\na,north,all,30\n",
        "sizes.add.xml": "<additional/>",
        "streets.sumocfg": '<configuration><input><net-file value="streets.net.xml"/>'
        '<route-files value="trips.rou.xml"/></input></configuration>',
        "tracks.csv": TRACKS,
        "other_tracks.csv": TRACKS.replace("2.5", "2.6"),
        "own.csv": "t,s,id,x,y,z,a,l,w,h,type\n0,0,a,0,0,1,0,4,2,1,car\n60,6,a,9,0,1,0,4,2,1,car\n",
        "others.csv": fcd.replace("-2.0", "-2.5"),
        "others.geojson": collection(feature(house, name="house", height_m=6)),
        "solids.poly.xml": '<additional><poly id="p" type="building" fill="1" shape="1,5 4,5 4,8"/></additional>',
        "parked.csv": "x_m,y_m,yaw_deg,type\n1,9,0,car\n",
        "trees.geojson": collection(feature(house, name="oak", kind="tree", height_m=6)),
        "five.csv": SITES + "b_high,30.5,-12,5\nc,2,-12,4\nd,38,12,4\n",
        "one.csv": "site,x_m,y_m,z_m\na,10,12,3\n",
        "sensors.csv": "site,x_m,y_m,z_m,sensor\na,10,12,3,VLP-32C\nb,30,12,3,\n",
        "places.csv": "site,x_m,y_m\na,10,12\n",
        "zones.csv": "zone,x_m,y_m\ncrossing,5,-8\ncrossing,12,-8\ncrossing,12,8\ncrossing,5,8\n",
        "other_zones.csv": "zone,x_m,y_m\ncrossing,20,-8\ncrossing,30,-8\ncrossing,30,8\n",
        "beams.csv": "elevation_deg,azimuth_deg\n0,0\n-5,90\n",
        "other_beams.csv": "elevation_deg,azimuth_deg\n0,0\n-5,80\n",
        "directions.csv": "elevation_deg,azimuth_deg,dwell_s\n0,0,1\n-5,90,1\n",
        "other_directions.csv": "elevation_deg,azimuth_deg,dwell_s\n0,0,1\n-5,90,2\n",
    }
    kinds = SCENARIO[SCENARIO.index("[[traffic.kinds]]") : SCENARIO.index("[statics]")]
    without_kinds = SCENARIO.replace(kinds, "").replace('fcd = "fcd.csv"', 'network = "streets.net.xml"')
    texts["without_kinds.toml"] = without_kinds
    for name, text in texts.items():
        (folder / name).write_text(text)
    for name, size_m in (("box.ply", 1), ("other_box.ply", 2)):
        box = trimesh.creation.box((size_m, size_m, size_m)).apply_translation((25, 8, 1))
        (folder / name).write_bytes(box.export(file_type="ply"))
    egvs.run(load(folder, ["sites.file='five.csv'"]), folder / "run")
    egvs.run(load(folder, ["sites.file='five.csv'", *HALVES]), folder / "run_of_periods")
    return folder


def outcome(key: str, small: Path, file: str, overrides: tuple[str, ...]) -> object:
    """What a key must change: candidate sites, a plan, bodies, or the keys of the stages with results."""
    scenario = load(small / file, overrides)
    run_folder = small / ("run_of_periods" if scenario.traffic.periods else "run")
    match key.partition(".")[0]:
        case "sites" if key != "sites.existing_poles":  # these change costs only
            return Inputs(scenario).plain_scene.sites
        case "costs" | "placement" | "sites":
            placed = solve_placement(open_folder(scenario, run_folder), exact=True, time_limit_s=60)
            return placed.sensors, placed.joint, placed.cost, placed.zones, [step.cost for step in placed.curve]
        case "what_if":
            runs = what_if.prepare_runs(small / file, overrides)
            statics = [(one.share, one.scenario.statics.footprints) for one in runs]
            return statics, what_if.solid_documents(scenario, "works")
        case "validation":
            return json.dumps(cloud_simulation.hash_body_files(scenario))
    context = open_folder(scenario, run_folder)
    return [stage_keys.stage_key(stage, context).key for stage in STAGES]


@pytest.mark.slow
@settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.filter_too_much])
@given(keys=st.dictionaries(st.sampled_from(sorted(KEYS)), st.booleans(), min_size=1, max_size=8))
@example({"traffic.signals.*.phases.*.green_s": False})
@example({"traffic.signals.*.file": False})
def test_scenario_that_loads_is_read_back_from_the_record_of_its_run(small: Path, keys: dict[str, bool]) -> None:
    """With all defaults, as in run.json; so are the scenarios of its periods and seeds."""
    overrides: list[str] = []
    for key, is_changed in keys.items():
        change = KEYS[key]
        overrides += change.base
        if is_changed:
            overrides += [override(key, change), *filter(None, [change.together_with])]
    try:
        scenario = load(small / KEYS[next(iter(keys))].file, list(dict.fromkeys(overrides)))
    except InputError:
        assume(False)
        raise
    record = json.loads(json.dumps(scenario.model_dump(mode="json")))
    read_back = scenario_from_dict(json.loads(json.dumps(record)), small, "run.json")
    assert read_back.model_dump(mode="json") == record
    for name, period in scenario.by_period().items():
        other = read_back.by_period()[name]
        assert [one.model_dump() for one in other.by_seed()] == [one.model_dump() for one in period.by_seed()]


def override(key: str, change: Change) -> str:
    """``--set`` of another value, in the first row of each list."""
    path = key
    for table, name in NAMES.items():
        path = path.replace(f"{table}.*", f"{table}.{name}")
    return f"{path.replace('*', '0')}={change.value}"


@pytest.mark.slow
@pytest.mark.parametrize("key", KEYS)
def test_another_value_of_a_key_has_an_effect(key: str, small: Path) -> None:
    change = KEYS[key]
    changed = [*change.base, override(key, change)]
    if change.together_with:
        changed.append(change.together_with)
    before = outcome(key, small, change.file, change.base)
    assert outcome(key, small, change.file, change.base) == before
    assert outcome(key, small, change.file, tuple(changed)) != before
