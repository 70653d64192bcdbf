"""What a check says of sites, solids, region, lanes, traffic and sensors: each case by hand, with its message."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import egvs
from egvs.cli.run_tables import print_check
from egvs.core.errors import DiagnosticsError, InputError
from egvs.report.sections import describe_poles_on_road
from egvs.sensors.sites import Pose, Site
from egvs.stages import check, scene_checks
from egvs.stages.inputs import CheckInputs, Inputs
from egvs.traffic import network
from egvs.world.carriageway import Carriageway
from tests.conftest import collection, feature
from tests.stage_runner import inputs_of
from tests.stages.conftest import LANES, net_xml

SCENARIOS = Path(__file__).resolve().parents[2] / "scenarios"


def found(folder: Path, *settings: str) -> dict[str, list[str]]:
    """What is found, by rule; errors as they are, warnings in brackets."""
    told: dict[str, list[str]] = {}
    for finding in check.check_scenario(egvs.load(folder, settings)).findings:
        line = f"{finding.where}: {finding.problem}".replace(f"{folder}/", "")
        told.setdefault(finding.rule, []).append(line if finding.is_error else f"[{line}]")
    return told


def box(low: tuple[float, float], high: tuple[float, float], name: str = "kiosk", **more: object) -> dict:
    (x0, y0), (x1, y1) = low, high
    ring = [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]
    return feature({"type": "Polygon", "coordinates": [ring]}, **{"name": name, "kind": "kiosk", "height_m": 3, **more})


def sites(folder: Path, *rows: str) -> None:
    (folder / "sites.csv").write_text("\n".join(["site,x_m,y_m,z_m", *rows]) + "\n")


def statics(folder: Path, *features: dict) -> None:
    (folder / "statics.geojson").write_text(collection(*features))


def test_valid_scenario_has_no_finding(street: Path, mini: Path) -> None:
    checked = check.check_scenario(egvs.load(street))
    assert (checked.findings, checked.sites, checked.solids, checked.lanes) == ((), 2, 3, 2)


def test_says_where_each_pole_stands(street: Path) -> None:
    """Lanes are 3.2 m wide and meet at y = 0; the building is at x 14 to 18 m, y 5 to 8 m."""
    sites(street, "beside,10,12,3", "high,10,12,5", "inside,30,1.2,8", "far,16,40,3")
    poles = {pole.pole: pole for pole in check.check_scenario(egvs.load(street)).poles}
    assert list(poles) == ["beside", "inside", "far"]
    assert poles["beside"].kerb_m == pytest.approx(12 - 3.2)
    assert poles["beside"].wall_m == pytest.approx(math.hypot(4, 4))
    assert poles["inside"].kerb_m == pytest.approx(2.0)
    assert poles["far"].wall_m == pytest.approx(32.0)
    lone, *_ = check.check_scenario(egvs.load(street, ["statics.footprints=[]"])).poles
    assert math.isnan(lone.wall_m)


def test_pole_without_network_and_walls_has_no_distances(mini: Path) -> None:
    lone, *_ = check.check_scenario(egvs.load(mini, ["statics.footprints=[]"])).poles
    assert (lone.where, math.isnan(lone.kerb_m), math.isnan(lone.wall_m)) == ("", True, True)


def test_no_lane_rule_applies_without_network(mini: Path) -> None:
    checked = check.check_scenario(egvs.load(mini))
    assert (checked.findings, checked.lanes) == ((), 0)


# ---- sites


def test_site_is_in_lane_from_a_quarter_metre_inside(street: Path) -> None:
    """Lanes of 3.2 m round y = +-1.6: from 0 to 3.2 m, so 2.94 is in one and 2.96 is not; 0 is the line between."""
    sites(street, "in,10,2.94,3", "kerb,10,2.96,3", "middle,12,0,3", "walk,10,-4.2,3", "bicycles,10,4.2,3", "e,9,-1,3")
    assert found(street) == {
        "sites on lanes": [
            "[sites.csv: site in: (10, 2.94, 3) is in lane west_1; the nearest kerb is at (10.0, 3.2)]",
            "[sites.csv: site e: (9, -1, 3) is in lane east_1; the nearest kerb is at (9.0, -3.2)]",
        ]
    }


def test_lane_is_named_by_its_street_or_junction(street: Path) -> None:
    named = LANES.replace('id="west"', 'id="west" name="High Street"')
    assert named != LANES
    lane = '<lane id=":j_0_0" index="0" length="9" speed="9" shape="90,0 99,0"/>'
    inside = f'<edge id=":j_0" function="internal">{lane}</edge>'
    (street / "net.net.xml").write_text(net_xml(named + inside))
    sites(street, "a,10,1.6,3", "b,95,0,3")
    lines = [line.partition(" is in ")[2].partition(";")[0] for line in found(street)["sites on lanes"]]
    assert lines == ["a lane of High Street", "junction j"]


def test_sensor_on_gantry_is_not_in_lane(street: Path) -> None:
    sites(street, "low,10,1.6,4.5", "high,10,1.6,4.51")
    assert [line for lines in found(street).values() for line in lines] == [
        "[sites.csv: site low: (10, 1.6, 4.5) is in lane west_1; the nearest kerb is at (10.0, 3.2)]"
    ]


def test_warns_of_site_within_junction_unless_above_road() -> None:
    """Of the hill's junction (0, -2) is in no lane, and (60, 12) is beside the road."""
    roads = Carriageway.of(network.read_net_xml(SCENARIOS / "hill" / "network.net.xml"))
    at_m = np.array([0.0, -2.0])
    road_m = roads.height_m(roads.nearest(at_m), at_m)
    assert roads.lanes_at(np.array([[*at_m, road_m + 2]])) == [None]
    places = {"low": (0.0, -2.0, road_m + 2), "high": (0.0, -2.0, road_m + 4.6), "beside": (60.0, 12.0, road_m + 2)}
    candidates = tuple(Site(name, Pose(*place), "VLP-32C") for name, place in places.items())
    subject = CheckInputs(egvs.load(SCENARIOS / "hill"), carriageway=roads, sites=candidates)
    (finding,) = scene_checks.warn_sites_on_lanes(subject)
    kerb = re.fullmatch(
        rf"\(0, -2, {road_m + 2:g}\) is within a junction; the nearest kerb is at \((\S+), (\S+)\)", finding.problem
    )
    assert kerb is not None
    at_m = np.array([[float(kerb[1]), float(kerb[2])]])
    assert np.hypot(*(roads.nearest_kerb_m(at_m) - at_m)[0]) < 0.1


def test_bridge_over_the_street_is_another_level(street: Path) -> None:
    """At z = 8 m, over the middle of the region: the street is in the region, and a sensor below stands in no lane."""
    bridge = '<lane id="bridge_0" index="0" length="80" shape="20,-40,8.00 20,40,8.00"/>'
    lanes = LANES + f'<edge id="bridge" from="c" to="d">{bridge}</edge>\n'
    (street / "net.net.xml").write_text(net_xml(lanes))
    statics(street)
    sites(street, "below,20,7,3", "deck,20,7,9", "street,20,1.6,3")
    result = found(street)
    assert "region" not in result
    assert [line.partition(";")[0].partition(" is in ")[::2] for line in result["sites on lanes"]] == [
        ("[sites.csv: site deck: (20, 7, 9)", "lane bridge_0"),
        ("[sites.csv: site street: (20, 1.6, 3)", "lane west_1"),
    ]


def test_height_above_road_decides(street: Path) -> None:
    lifted = LANES.replace("80,1.60 -40,1.60", "80,1.60,4.00 -40,1.60,4.00").replace(
        "-40,-1.60 80,-1.60", "-40,-1.60,4.00 80,-1.60,4.00"
    )
    (street / "net.net.xml").write_text(net_xml(lifted))
    sites(street, "low,10,1.6,8.4", "high,10,1.6,8.6")
    told = found(street, "roi.center_m=[20,0,6.5]")
    assert [line.partition(" is in lane")[0] for line in told["sites on lanes"]] == [
        "[sites.csv: site low: (10, 1.6, 8.4)"
    ]


def test_many_sites_in_lanes_share_one_warning(street: Path) -> None:
    sites(street, *(f"s{i:02d},{i},1.6,3" for i in range(1, 13)))
    lines = found(street)["sites on lanes"]
    assert len(lines) == 9
    assert lines[-1] == "[sites.csv: 4 more of 12 are in lanes or junctions: s09, s10, s11, s12]"


def test_result_names_the_poles_of_these_warnings(street: Path) -> None:
    """The wording of the check and the reader of the report agree."""
    sites(street, *(f"s{i:02d},{i},1.6,3" for i in range(1, 13)))
    warnings = check.check_scenario(egvs.load(street)).findings
    poles = [SimpleNamespace(name=f"pole {name}", sites=[SimpleNamespace(site=name)]) for name in ("s01", "s12", "s13")]
    first, last = describe_poles_on_road(poles, warnings)
    assert first.startswith("pole s01 stands in lane ")
    assert last == "pole s12 stands in a lane or junction"


def mast(at_m: tuple[float, float], name: str, kind: str = "mast") -> dict:
    return feature({"type": "Point", "coordinates": at_m}, name=name, kind=kind, height_m=4, radius_m=0.1)


def test_masts_that_carry_sensors_are_a_note(street: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """They are there on purpose, and need no attention."""
    statics(street, mast((10, 6), "m1"), mast((20.3, 6), "m2", "pole"), mast((30, 8), "m3"))
    (street / "sites.csv").write_text("site,x_m,y_m\na,10,6\nb,20,6\nc,30,6\n")
    assert found(street, "sites.heights_m=[3, 4, 5]") == {
        "own supports": [
            "[statics: 2 solids carry sensors and are left out of their scans: m1 (mast) at a, m2 (pole) at b]"
        ]
    }
    checked = check.check_scenario(egvs.load(street, ["sites.heights_m=[3, 4, 5]"]))
    assert (checked.warnings, [note.rule for note in checked.notes]) == ((), ["own supports"])
    print_check(checked)
    printed = capsys.readouterr().out
    assert "\n1 note\n" in printed and "no errors or warnings" in printed


def test_candidate_of_a_rule_may_be_on_a_pole_but_not_in_a_house(street: Path) -> None:
    statics(street, mast((6, 6), "m1"), box((10, 5), (12, 7)))
    rule(street, "{ low_m=[6,6], high_m=[16,6], spacing_m=5, heights_m=[2.0] }")
    told = found(street)
    listed = "m1 (mast) at g01"
    assert told["own supports"] == [f"[statics: a solid carries sensors and is left out of their scans: {listed}]"]
    assert (
        "1 of 3 candidates are dropped, because no pole can stand there (1 in a solid)" in told["dropped candidates"][0]
    )


@pytest.mark.slow
@pytest.mark.parametrize("keep", ["true", "false"])
def test_run_warns_of_site_whose_beams_mostly_end_near_it(mini: Path, keep: str) -> None:
    cage = feature({"type": "Point", "coordinates": [10, 12]}, name="cage", kind="kiosk", height_m=2.99, radius_m=0.6)
    statics(mini, cage)
    record = egvs.run(egvs.load(mini, [f"scan.keep={keep}"]), mini / "out")
    stage = "scan" if keep == "true" else "score"
    (warning,) = [w for w in record.stages[stage].summary["warnings"] if w["rule"] == "blocked sites"]
    assert warning["problem"].startswith("most beams of 1 of 2 sites end within 0.5 m of the sensor: pole_a (")
    assert not [w for s, r in record.stages.items() if s != stage for w in r.summary.get("warnings", ())
                if w["rule"] == "blocked sites"]  # fmt: skip


def rule(folder: Path, grid: str) -> None:
    text = (folder / "scenario.toml").read_text()
    (folder / "scenario.toml").write_text(text.replace('file = "sites.csv"', f"grid = {grid}"))


def test_rule_drops_candidates_in_lanes_and_solids(street: Path) -> None:
    """Rows at y = -6, -1, 4 and 9: the second is in a lane, whatever the height; of the last, one is in the house (from
    x = 14 to 18, y = 5 to 8, made wider here), but not above it."""
    statics(street, box((14, 5), (18, 10), "house", height_m=6))
    rule(street, "{ low_m=[6,-6], high_m=[26,9], spacing_m=5, heights_m=[3.0, 7.0] }")
    checked = check.check_scenario(egvs.load(street))
    assert [str(finding) for finding in checked.findings] == [
        "sites.grid: 11 of 40 candidates are dropped, because no pole can stand there (10 in a lane, 1 in a solid). "
        "List sensors on gantries or islands in a sites file."
    ]
    scene = egvs.build_scene(egvs.load(street))
    assert (len(scene.sites), checked.sites) == (29, 29)
    assert {site.pose.y_m for site in scene.sites} == {-6.0, 4.0, 9.0}
    assert [(site.pose.position_m, why) for site, why in scene.dropped if site.pose.y_m > 4] == [
        ((16.0, 9.0, 3.0), "in a solid")
    ]


def test_rule_drops_candidates_within_junction_but_not_on_walkways(street: Path) -> None:
    """A junction of 8 x 8 m beside the lanes, its corner in the north-east a walking area of 2 x 2 m."""
    area = '<edge id=":j_w0" function="walkingarea"><lane id=":j_w0_0" index="0" allow="pedestrian" length="2"'
    corner = f'{area} width="2" shape="18,-6 20,-6 20,-8 18,-8"/></edge>'
    shape = 'shape="12,-6 20,-6 20,-14 12,-14"'
    junction = f'<junction id="j" type="priority" x="16" y="-10" incLanes="east_1" {shape}/>'
    (street / "net.net.xml").write_text(net_xml(f"{LANES}{corner}{junction}"))
    rule(street, "{ low_m=[11,-15], high_m=[19,-7], spacing_m=2, heights_m=[3.0] }")
    scene = egvs.build_scene(egvs.load(street))
    dropped = {site.pose.position_m[:2] for site, why in scene.dropped if why == "in a junction"}
    assert dropped == {(x, y) for x in (13, 15, 17, 19) for y in (-13, -11, -9, -7)} - {(19, -7)}


def test_rule_that_drops_nothing_is_checked_like_a_file(street: Path) -> None:
    rule(street, "{ low_m=[6,-6], high_m=[16,9], spacing_m=5, heights_m=[3.0] }")
    told = found(street, "sites.only_free=false")
    assert {key: len(lines) for key, lines in told.items()} == {"sites on lanes": 3}


def test_rejects_rule_without_feasible_candidate(street: Path) -> None:
    rule(street, "{ low_m=[6,1], high_m=[16,1], spacing_m=5, heights_m=[3.0] }")
    assert found(street) == {"sites": ["scenario.toml: sites: no location can hold a pole (3 in a lane)"]}


def test_rejects_visibility_of_dropped_site(street: Path) -> None:
    rule(street, "{ low_m=[6,-6], high_m=[6,-1], spacing_m=5, heights_m=[3.0] }")
    told = found(street, 'score.keep_visibility=["g02"]')
    assert told == {"sites": ["command line: score.keep_visibility: the site 'g02' is dropped: it stands in a lane"]}


def test_warns_of_beams_that_miss_region(street: Path) -> None:
    sensor = "{elevations_deg=[5,15],channels=4,azimuth_step_deg=1.0,range_m=100}"
    told = found(street, f"sensors.small={sensor}", "roi.center_m=[20,0,1.0]", "roi.size_m=[40,20,2]")
    assert told.pop("upward beams") == [
        "[sensors.small: 100 % of the beams point above the horizon at 2 sites: pole_a, pole_b]"
    ]
    assert told == {
        "beams beside the region": [
            "[sites: 2 of 2 sites have no beam that meets the region of interest: pole_a, pole_b]"
        ]
    }


def test_warns_once_of_a_sensor_whose_beams_point_up_where_it_hangs(street: Path) -> None:
    """Of 4 elevations from -25 to 5 degrees one points up, and three upside down; RS-Ruby Plus is made so."""
    rows = ["a,20,12,3,0,inverted,wide", "b,25,12,3,0,inverted,wide", "c,30,12,3,0,upright,wide"]
    rows += [
        "d,35,12,3,0,upright,RS-Ruby Plus",
        "g,40,12,3,0,upright,",
        "e,20,12,6,0,inverted,VLP-16",
        "f,25,12,6,-5,upright,OS1-64",
    ]
    (street / "sites.csv").write_text("\n".join(["site,x_m,y_m,z_m,pitch_deg,mount,sensor", *rows, ""]))
    told = found(street, "sensors.wide={elevations_deg=[-25,5],channels=4,azimuth_step_deg=0.5,range_m=100}")
    assert told["upward beams"] == [
        "[sensors.wide: 75 % of the beams point above the horizon at 2 sites (upside down): a, b]"
    ]


def test_reports_all_wrong_poses_at_once(street: Path) -> None:
    sites(street, "inside,16,6,3", "deep,10,12,-1", "far,300,12,3", "fine,10,12,3")
    assert found(street) == {
        "sites": [
            "site inside: (16, 6, 3) is inside house (building)",
            "site deep: z_m = -1 is not above the ground (z = 0)",
            "site far: the site is 260.0 m from the region of interest",
        ]
    }


# ---- solids


def test_warns_of_solid_on_lane_with_position(street: Path) -> None:
    """2 x 2 m of two lanes that are 2.7 m wide without their edges and 120 m long: 4 of 2 * 2.7 * 120 m2."""
    statics(street, box((20, 0.5), (22, 2.5), "shelter", base_m=2.4, height_m=2.6))
    share, lanes = 4 / (2 * 2.7 * 120), "of the lanes in and around the region"
    assert found(street) == {
        "solids over lanes": [f"[statics: 1 solid covers {100 * share:.1f} % {lanes}: shelter (kiosk) 4 m2 at (21, 2)]"]
    }


@pytest.mark.parametrize(
    ("solid", "is_found"),
    [
        (box((20, 0.5), (22, 2.5), base_m=4.5, height_m=6), False),  # a bridge
        (box((20, 0.5), (22, 2.5), height_m=0.3), False),  # an island
        (box((20, 0.5), (22, 2.5), height_m=0.31), True),
        (box((20, 2.9), (30, 6)), False),  # touches: 0.05 m of the inset lane
        (box((20, 2.7), (30, 6)), True),  # 0.25 m of it, 2.5 m2
        (box((20, 1.5), (20.2, 1.7)), True),  # a post, small, but in the middle of a lane
        (box((20, 2.9), (20.2, 3.1)), False),  # one at the kerb
        (box((200, 0.5), (222, 2.5)), False),  # too far away to matter
    ],
)
def test_solid_in_the_way_on_lane(street: Path, solid: dict, is_found: bool) -> None:
    statics(street, solid)
    assert set(found(street)) == ({"solids over lanes"} if is_found else set())


def test_open_surface_above_kerb_is_in_the_way(street: Path) -> None:
    """A sheet over the whole street is the road at 0.1 m, and in everybody's way at 1 m."""
    for height_m, is_found in ((0.1, False), (1.0, True)):
        corners = "".join(f"v {x} {y} {height_m}\n" for x, y in ((-40, -6), (80, -6), (80, 6), (-40, 6)))
        (street / "sheet.obj").write_text(corners + "f 1 2 3\nf 1 3 4\n")
        told = found(street, "statics.footprints=[]", 'statics.meshes=[{file="sheet.obj"}]')
        assert set(told) == ({"solids over lanes"} if is_found else set())
        if is_found:
            assert "1 solid covers 100.0 % of the lanes" in told["solids over lanes"][0]


@pytest.mark.parametrize(
    ("low_m", "high_m", "y_m", "is_found"),
    [(0, 20, 1.5, True), (0, 1.9, 1.5, False), (4.6, 20, 1.5, False), (0, 20, 8, False), (0, 20, -1.5, True)],
)
def test_wall_without_an_inside_is_across_lanes(
    street: Path, low_m: float, high_m: float, y_m: float, is_found: bool
) -> None:
    """As the ground of a surface with y up: a plane that stands on the road, and has no area in plan."""
    z_m = np.linspace(low_m, high_m, 21)
    corners = "".join(f"v {x} {y_m} {z}\n" for z in z_m for x in (5, 25))
    faces = "".join(f"f {k} {k + 1} {k + 3}\nf {k} {k + 3} {k + 2}\n" for k in range(1, 41, 2))
    (street / "wall.obj").write_text(corners + faces)
    told = found(street, 'statics.meshes=[{file="wall.obj"}]')
    lines = told.get("solids over lanes", [])
    assert [line.startswith("[statics: walls of wall") for line in lines] == ([True] if is_found else [])


@pytest.mark.parametrize(("pitch_deg", "is_found"), [(-60.0, False), (0.0, False), (30.0, False), (60.0, True)])
def test_beams_of_a_site_in_the_region_reach_it_unless_all_point_up(
    street: Path, pitch_deg: float, is_found: bool
) -> None:
    (street / "sites.csv").write_text(f"site,x_m,y_m,z_m,yaw_deg,pitch_deg\na,20,6,3,-90,{pitch_deg}\n")
    sensor = "{elevations_deg=[-10,10],channels=4,azimuth_step_deg=1.0,azimuth_deg=[-20,20],range_m=100}"
    told = found(street, f"sensors.small={sensor}", "roi.center_m=[20,0,2.5]", "roi.size_m=[40,20,5]")
    assert ("beams beside the region" in told) == ("nose up" in told) == is_found


def test_warns_of_distant_buildings(street: Path) -> None:
    statics(street, box((1000, 2000), (1010, 2010)), box((1100, 2000), (1110, 2010)))
    assert found(street) == {
        "statics far away": [
            "[statics: the nearest solid is 2,209 m from the region of interest; all solids are around (1055, 2005)]"
        ]
    }


# ---- the region


def test_rejects_region_without_lanes(street: Path) -> None:
    sites(street, "a,20,210,3")
    statics(street)
    told = found(street, "roi.center_m=[20,200,2.5]")
    assert told == {
        "region": [
            "scenario.toml: roi: no lane passes through the region: the nearest is 187.1 m away, "
            "lanes extend from (-40, -3) to (80, 3)"
        ]
    }


def test_rejects_region_above_road(street: Path) -> None:
    told = found(street, "roi.center_m=[20,0,22.5]")
    assert told["region"] == [
        "scenario.toml: roi: the region extends from z = 20 to 25 m, but the road is at z = 0.0 m"
    ]


# ---- all at once


def test_reports_all_errors_at_once(street: Path, run_egvs) -> None:
    sites(street, "in,10,1.6,3", "house,16,6,3")
    (street / "broken.geojson").write_text("{")
    settings = (
        'sites.sensor="smal"', "traffic.frame_period_s=0.3", "traffic.edge_weights={north=2}",
        'statics.footprints=["statics.geojson","gone.geojson","broken.geojson"]',
    )  # fmt: skip
    told = found(street, *settings)
    assert {key: len(lines) for key, lines in told.items()} == {
        "files": 1, "statics": 1, "traffic": 2, "sensors": 1, "sites on lanes": 1,
    }  # fmt: skip
    assert told["sensors"] == ["--set: sites.sensor: unknown sensor 'smal'"]
    flags = [word for setting in settings for word in ("--set", setting)]
    code, printed, _ = run_egvs("check", street, *flags)
    assert code == 2
    assert printed.splitlines()[0] == "5 errors"
    assert "1 warning" in printed.splitlines()
    code, _, said = run_egvs("run", street, "--out", street / "out", *flags)
    said = said.replace(f"{street}/", "")
    assert code == 2
    assert all(line.partition(": ")[2] in said for lines in told.values() for line in lines if line[0] != "[")
    assert not list((street / "out").glob("[!.]*"))


def test_rejects_truncated_network_before_building(street: Path) -> None:
    (street / "net.net.xml").write_text(net_xml()[:300])
    told = found(street)
    assert list(told) == ["network"]
    with pytest.raises(DiagnosticsError, match="is not well-formed XML"):
        egvs.run(egvs.load(street), street / "out")


@pytest.mark.parametrize("softness", [0, 0.3])
def test_rejects_range_limit_without_rated_range(street: Path, softness: float) -> None:
    told = found(street, f"effects.range_limit={{reflectivity=0.1, softness={softness}}}")
    assert told == {"effects": ["effects.range_limit: sensor small: rated_range_m is missing"]}


SURFACES = "effects.surface_losses={}"
RATED = ("sensors.small.rated_range_m=30", "sensors.small.rated_reflectivity=0.1")


def test_warns_about_surfaces_that_lose_returns_twice(street: Path) -> None:
    problem = "dark vehicles and windows are part of the losses of returns too: clouds lose these returns twice"
    twice = {"losses twice": [f"[scenario.toml: effects.surface_losses: {problem}]"]}
    assert found(street, SURFACES, *RATED) == twice
    assert found(street, SURFACES, *RATED, "effects.range_limit={}") == twice
    for settings in ((SURFACES,), RATED, (SURFACES, *RATED, "effects.range_limit=false")):
        assert found(street, *settings) == {}


def test_warns_about_a_rated_range_without_its_reflectivity(street: Path) -> None:
    told = found(street, RATED[0])
    problem = "rated_reflectivity is missing: 30 m are taken as rated for a target of 80 %"
    assert told == {"rated range": [f"[scenario.toml: sensors.small: {problem}]"]}
    assert list(found(street, "effects.range_limit={rated_range_m=40}")) == ["rated range"]
    for setting in ("sensors.small.rated_reflectivity=0.8", "effects.range_limit=false",
                    "effects.range_limit={rated_reflectivity=0.1}"):  # fmt: skip
        assert found(street, RATED[0], setting) == {}


# ---- the command, and the run


def test_check_command_without_findings_writes_nothing(street: Path, run_egvs) -> None:
    before = sorted(street.rglob("*"))
    code, printed, _ = run_egvs("check", street)
    _, *poles, _, verdict, counts = printed.splitlines()
    assert (code, verdict, counts) == (0, "no errors or warnings", "checked 2 sites, 3 solids and 2 lanes")
    assert [line.split()[:5] for line in poles] == [
        ["pole_a", "10.0", "12.0", "8.8", "5.7"], ["pole_b", "30.5", "-12.0", "8.8", "21.1"],
    ]  # fmt: skip
    assert sorted(street.rglob("*")) == before


@pytest.mark.slow
def test_run_records_and_shows_warnings(mini: Path, run_egvs) -> None:
    statics(mini, box((1000, 2000), (1010, 2010)))
    for state in ("nearest solid", "unchanged"):
        code, _, said = run_egvs("run", mini, "--out", mini / "out")
        assert (code, state in said, "warning: statics: the nearest solid is 2,209 m" in said) == (0, True, True)
    record = json.loads((mini / "out" / "run.json").read_text())
    assert [warning["rule"] for warning in record["stages"]["check"]["summary"]["warnings"]] == ["statics far away"]
    assert "the nearest solid is 2,209\u00a0m" in (mini / "out" / "report.html").read_text()
    assert run_egvs("verify", mini / "out")[0] == 0


def test_diagnostics_error_is_input_error(street: Path) -> None:
    with pytest.raises(InputError) as caught:
        egvs.run(egvs.load(street, ['sites.sensor="smal"', "traffic.edge_weights={north=2}"]), street / "out")
    assert len(str(caught.value).splitlines()) == 2


def test_warns_of_repeated_beams(street: Path) -> None:
    """They count twice, since a table is taken as it is."""
    (street / "beams.csv").write_text("elevation_deg,azimuth_deg\n-5,0\n-5,90\n-5,360\n-9,0\n")
    told = found(street, 'sensors.own={beams="beams.csv",range_m=90}', 'sites.sensor="own"', 'sites.aim="roi"')
    assert told == {
        "repeated beams": [
            "[beams.csv: 1 of 4 beams have the same direction as an earlier one (beam 2 = beam 0) and count twice]"
        ],
        "few beams": ["[beams.csv: own has 4 beams in a turn or frame; a LiDAR has thousands]"],
    }


@pytest.mark.parametrize(
    ("rings", "message"),
    [
        ("elevations_deg=[-15,-15,-15,-5]", "8 of 16 beams have the same direction"),
        ("elevations_deg=[-15,-15],channels=3", "8 of 12 beams have the same direction"),
        ("elevations_deg=[-15,-5,-15],azimuth_offsets_deg=[0,0,90]", "4 of 12 beams have the same direction"),
    ],
)
def test_warns_of_repeated_rings(street: Path, rings: str, message: str) -> None:
    settings = (f"sensors.own={{{rings},azimuth_step_deg=90,range_m=90}}", 'sites.sensor="own"', 'sites.aim="roi"')
    (told,) = found(street, *settings)["repeated beams"]
    assert told.startswith("[scenario.toml: sensors.own.elevations_deg: ")
    assert message in told


def test_rings_at_one_elevation_with_other_azimuths_are_no_repetition(street: Path) -> None:
    rings = "elevations_deg=[-15,-15],azimuth_offsets_deg=[0,45],azimuth_step_deg=90,range_m=90"
    findings = found(street, f"sensors.own={{{rings}}}", 'sites.sensor="own"', 'sites.aim="roi"')
    assert list(findings) == ["few beams"]  # eight of them


# ---- files, and the keys of the stage


def test_reports_all_wrong_rows_of_sites_file(street: Path) -> None:
    sites(street, "a,10,12,x", "b,10,12,3", "b,11,12,3", "c,,12,3", "d,10,12,3", "e,1_0,12,3", "f,10,\u0661\u0662,3")
    assert found(street) == {
        "sites": [
            "sites.csv: line 2 (a): z_m: expected a finite number of at most 1e+08, got 'x'",
            "sites.csv: line 4 (b): there are two sites 'b'",
            "sites.csv: line 5 (c): x_m is missing",
            "sites.csv: line 7 (e): x_m: expected a finite number of at most 1e+08, got '1_0'",
            "sites.csv: line 8 (f): y_m: expected a finite number of at most 1e+08, got '\u0661\u0662'",
        ]
    }


def test_equal_findings_of_many_sites_are_joined(street: Path) -> None:
    """An aim needs the sensor, so each row is rejected for it; the message names the key that sets the sensor."""
    told = found(street, 'sites.sensor="smal"', 'sites.aim="roi"')
    assert told == {"sites": ["--set: sites.sensor: unknown sensor 'smal'"]}


def test_reports_missing_files_and_unknown_formats(street: Path) -> None:
    (street / "sites.csv").write_text("site,x_m,y_m,z_m,points\na,10,12,3,gone.pcd\nb,12,12,3,scan.xyz\nc,14,12,3,\n")
    (street / "scan.xyz").write_text("")
    told = found(street, 'statics.polygons=["gone.poly.xml"]', 'sensors.own={beams="beams.csv",range_m=50}')
    assert {line.partition(": no such")[0] for line in told["files"][:3]} == {
        "command line: statics.polygons = 'gone.poly.xml'",
        "command line: sensors.own.beams = 'beams.csv'",
        "scenario.toml: site a: points = 'gone.pcd'",
    }
    assert "scan.xyz" in told["files"][3]
    assert len(told["files"]) == 4


def test_missing_file_of_period_is_reported_once(street: Path) -> None:
    """The rules that would read it find it missing too."""
    told = found(street, 'traffic.periods=[{name="a",sumocfg="gone.sumocfg"},{name="b",vehicles=3}]')
    (line,) = (line for lines in told.values() for line in lines)
    assert line.startswith("scenario.toml: traffic.periods (a).sumocfg = 'gone.sumocfg': no such file")


def test_reports_warnings_as_well_as_errors(street: Path, run_egvs) -> None:
    sites(street, "amid,10,1.6,3")
    code, _, err = run_egvs("run", street, "--set", "traffic.edge_weights={north=2}")
    assert code == 2
    warning, error = err.splitlines()
    assert warning.startswith("warning: sites.csv: site amid: (10, 1.6, 3) is in lane west_1")
    assert error.startswith("egvs: ") and "the network has no edge 'north'" in error


def test_reports_counts_at_unknown_edges_and_kinds(street: Path) -> None:
    counts = (
        '[{edge="east",per_hour=100},{edge="north",per_hour=9},{from_edge="east",to_edge="up",per_hour=9,kind="ox"}]'
    )
    told = found(street, f"traffic.counts={counts}")
    assert [line.partition("): ")[2] for line in told["traffic"]] == [
        "the network has no edge 'north'", "the fleet has no vehicle kind 'ox'", "the network has no edge 'up'",
    ]  # fmt: skip


def test_rejects_count_on_impossible_route(street: Path) -> None:
    (told,) = found(street, 'traffic.counts=[{from_edge="east",to_edge="west",per_hour=9}]')["traffic"]
    assert told == "scenario.toml: traffic.counts (east to west): there is no route from 'east' to 'west'"


def test_junction_with_invalid_walking_areas_drops_candidates() -> None:
    """Those of the hill, made valid, are areas with lines beside them, which GEOS subtracts from nothing."""
    roads = Carriageway.of(network.read_net_xml(SCENARIOS / "hill" / "network.net.xml"))
    at_m = np.array([[0.0, 0.0], [2.0, -2.0], [15.0, 14.0], [60.0, 12.0]])
    assert roads.in_junctions(at_m).tolist() == [True, True, False, False]


def test_file_keeps_all_sites(street: Path) -> None:
    with pytest.raises(InputError, match="only_free has no effect with file"):
        egvs.load(street, ["sites.only_free=false"])


def test_changed_input_repeats_check(street: Path) -> None:
    """Each file that it reads, and no setting of what comes of a run."""
    (street / "scan.csv").write_text("x_m,y_m,z_m\n30.5,0,0\n")
    (street / "sites.csv").write_text("site,x_m,y_m,z_m,points\na,10,12,3,\nb,12,12,3,scan.csv\n")

    def key(*settings: str) -> object:
        return inputs_of(check, egvs.load(street, settings), street / "out").to_json()

    before = key()
    for setting in ("roi.voxel_m=0.25", "score.gamma=9", "tpog.blocks=2", "seed=3", "scan.keep=false"):
        assert key(setting) == before
    for setting in ("roi.center_m=[21,0,2.5]", "sites.roll_deg=1", "traffic.step_s=0.5", "effects.rain.rate_mm_h=9"):
        assert key(setting) != before
    for name in ("net.net.xml", "sites.csv", "statics.geojson"):
        (street / name).write_text((street / name).read_text() + "\n")
        now = key()
        assert now != before, name
        before = now
    (street / "scan.csv").unlink()
    assert key() != before


@pytest.mark.parametrize("text", ["<osm/>", "<OpenDRIVE/>", "\0\0\0\rOSMHeader"])
@pytest.mark.parametrize("key", ["network", "roads"])
def test_rejects_map_as_network(street: Path, text: str, key: str) -> None:
    """By its content, whatever its name."""
    (street / "map.xml").write_text(text)
    traffic = {"network": 'network = "map.xml"', "roads": 'fcd = "fcd.csv"\nroads = "map.xml"'}
    scenario = street / "scenario.toml"
    scenario.write_text(scenario.read_text().replace('network = "net.net.xml"', traffic[key]))
    errors = [line for lines in found(street).values() for line in lines]
    assert errors == ["map.xml: expected a SUMO network, got a map"]


# ---- the scene alone


def test_check_with_scene_report_finds_the_same(street: Path) -> None:
    statics(street, box((-3, -3), (3, 3)))  # over the lanes
    inputs = Inputs(egvs.load(street))
    report = check.check_scene(inputs)
    assert report is not None
    complete = check.check_inputs(inputs)
    assert complete.warnings
    assert check.check_inputs(inputs, check.SceneReport.from_json(json.loads(json.dumps(report.to_json())))) == complete


def test_scene_is_checked_before_its_traffic_exists(mini: Path) -> None:
    before = check.check_scene(Inputs(egvs.load(mini)))
    (mini / "fcd.csv").unlink()
    assert check.check_scene(Inputs(egvs.load(mini))) == before
    (finding,) = check.check_inputs(Inputs(egvs.load(mini)), before).findings
    assert finding.is_error and "fcd.csv" in f"{finding.where} {finding.problem}"


def test_no_scene_report_where_the_complete_check_is_necessary(mini: Path) -> None:
    assert check.check_scene(Inputs(egvs.load(mini, ["effects.articulated.kinds.bus.parts_m=[9.0, 9.0]"]))) is None
    sites(mini, "below,20,12,-5")
    assert check.check_scene(Inputs(egvs.load(mini))) is None
