"""Where a scenario's world frame is on the Earth, according to its network and ``[crs]``.

The reference is the map: a node of OpenStreetMap has a longitude and latitude, the junction that netconvert makes of
it an x, y.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.core.sumo_home import sumo_home
from egvs.formats import osm
from egvs.scenario.loading import scenario_from_dict
from egvs.scenario.model import Scenario
from egvs.traffic import network, sumo
from egvs.traffic.network import Location
from egvs.world import geolocation

SMALL = Path(__file__).parents[1] / "creation" / "data" / "small.osm"
REAL = Path(__file__).parents[3] / "shared" / "real" / "bad_hersfeld.osm"
INGOLSTADT = "tools/game/fkk_in/ingolstadt.net.xml.gz"


def load(folder: Path, traffic: dict[str, Any], center: tuple[float, float] = (0, 0), **values: Any) -> Scenario:
    roi = {"center_m": [*center, 2.5], "size_m": [60, 60, 5]}
    return scenario_from_dict(
        {"roi": roi, "traffic": traffic, "sites": {"file": "s.csv"}, **values}, folder, "scenario.toml"
    )


def with_location(folder: Path, projection: str, offset: str = "-550000.00,-5634000.00") -> dict[str, Any]:
    lane = '<lane id="a_0" index="0" speed="10" length="9" shape="0,0 9,0"/>'
    (folder / "n.net.xml").write_text(
        f'<net><location netOffset="{offset}" projParameter="{projection}"/>'
        f'<edge id="a" from="n" to="m">{lane}</edge></net>'
    )
    return {"network": "n.net.xml"}


UTM = "+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("map_file", [SMALL, pytest.param(REAL, marks=pytest.mark.skipif(
    not REAL.is_file(), reason="bad_hersfeld.osm is not beside the checkout (shared/real)"))])  # fmt: skip
def test_junctions_are_at_their_map_nodes(tmp_path: Path, map_file: Path) -> None:
    map_path = tmp_path / "m.osm"
    map_path.write_bytes(map_file.read_bytes())
    sumo.run_netconvert(["--osm-files", map_path.name, "--junctions.join"], tmp_path, "n.net.xml")
    world = geolocation.scenario_georeference(load(tmp_path, {"network": "n.net.xml"}))
    assert world.frame is not None
    nodes = osm.read_osm(map_file).nodes
    known = [j for j in network.read_net_xml(tmp_path / "n.net.xml").junctions if j.id.isdigit() and int(j.id) in nodes]
    assert len(known) > 5
    junctions = np.array([j.at_m for j in known])
    lon_lat_deg = np.array([nodes[int(j.id)] for j in known])[:, ::-1]
    distances_m = np.hypot(*(world.frame.from_lon_lat(lon_lat_deg) - junctions).T)
    assert np.median(distances_m) < 0.01  # netconvert writes centimetres
    assert np.ptp(junctions, axis=0).min() > 100
    back = world.lon_lat_deg(junctions)
    assert back is not None
    assert np.median(np.abs(back - lon_lat_deg)) < 2e-7


def test_agrees_with_sumolib_on_real_network(tmp_path: Path) -> None:
    """Against sumolib, which inverts the same location with its own code."""
    import sumolib

    world = geolocation.scenario_georeference(load(tmp_path, {"network": f"$SUMO_HOME/{INGOLSTADT}"}, (5770, 5665)))
    lon_lat_deg_of_town = world.lon_lat_deg(np.array([[5770.0, 5665.0], [5525.68, 5517.09]]))
    assert lon_lat_deg_of_town is not None
    net = sumolib.net.readNet(str(sumo_home() / INGOLSTADT))
    assert lon_lat_deg_of_town[0] == pytest.approx(net.convertXY2LonLat(5770, 5665), abs=1e-8)
    assert lon_lat_deg_of_town[1] == pytest.approx((11.42, 48.77), abs=0.02)


def test_drawn_network_has_no_frame(tmp_path: Path) -> None:
    for projection in ("!", "", "-", "."):
        scene = load(tmp_path, with_location(tmp_path, projection))
        assert geolocation.scenario_georeference(scene).frame is None
        assert ("world_frame" in geolocation.world_frame_settings(scene)) == (projection in ("-", "."))


def test_missing_network_is_no_error(tmp_path: Path) -> None:
    """Statics, scans and scores can be made again where only they are kept."""
    for traffic in ({"network": "gone.net.xml"}, {"sumocfg": "gone.sumocfg"}):
        scene = load(tmp_path, traffic)
        assert geolocation.scenario_georeference(scene).frame is None
        assert geolocation.world_frame_settings(scene) == {}


def test_crs_of_scenario_gives_frame(tmp_path: Path) -> None:
    crs = {"epsg": 32632, "offset_m": [-550000, -5634000]}
    scene = load(tmp_path, {"fcd": "f.csv"}, (700, 1200), crs=crs)
    by_net = load(tmp_path, with_location(tmp_path, UTM), (700, 1200))
    declared, from_network = (
        geolocation.scenario_georeference(s).lon_lat_deg(np.array([[700.0, 1200.0]])) for s in (scene, by_net)
    )
    assert np.array_equal(declared, from_network)
    assert geolocation.world_frame_settings(scene) == {"world_frame": {"crs": [32632, -550000, -5634000]}}
    assert geolocation.world_frame_settings(by_net) == {"world_frame": {"location": [UTM, -550000, -5634000]}}
    assert geolocation.world_frame_settings(load(tmp_path, {"fcd": "f.csv"})) == {}
    geolocation.scenario_georeference(load(tmp_path, with_location(tmp_path, UTM), (700, 1200), crs=crs))


@pytest.mark.parametrize(
    ("crs", "message"),
    [
        ({"epsg": 4326}, r"crs.epsg: EPSG:4326 \(WGS 84\) is not a map projection. Use a projection in metres"),
        ({"epsg": 2263}, r"crs.epsg: EPSG:2263 .* has axes in US survey foot"),
        ({"epsg": 1}, "crs.epsg: unknown coordinate reference system 'EPSG:1'"),
        ({"epsg": 3857, "offset_m": [-1081000, -6594000]},
         r"crs: epsg = 3857 scales lengths by 1.58 at the region of interest \(longitude 9.71\d*, latitude "
         r"50.8\d*\). Use a system .* e.g. epsg = 32632, with its offset_m"),
        ({"epsg": 25832}, r"crs: epsg = 25832 .*(is outside of|scales lengths|puts the region)"),  # a forgotten offset
        ({"epsg": 32633, "offset_m": [-550000, -5634000]}, r"puts the region of interest [\d,]+ m from where"),
        ({"epsg": 25832, "offset_m": [-550000, -5634020]},
         r"puts the region of interest 20 m from where the network's <location> puts it .*"
         r"Remove \[crs\], or make it agree: netOffset \[-550000.0, -5634000.0\], projParameter '\+proj=utm \+zone=32"),
    ],
)  # fmt: skip
def test_rejects_contradictory_crs(tmp_path: Path, crs: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        geolocation.scenario_georeference(load(tmp_path, with_location(tmp_path, UTM), (700, 1200), crs=crs))


def test_rejects_network_that_distorts_lengths(tmp_path: Path) -> None:
    """Vehicles keep their size, streets do not: at 51 degrees Web Mercator draws them 1.6 times as long."""
    scene = load(tmp_path, with_location(tmp_path, "EPSG:3857", "-1081000,-6594000"), (700, 1200))
    with pytest.raises(InputError, match=r"the network: its <location> \(EPSG:3857\) scales lengths by 1.58"):
        geolocation.scenario_georeference(scene)
    geolocation.scenario_georeference(
        load(tmp_path, with_location(tmp_path, UTM, "0,0"), (700, 1200))
    )  # a forgotten offset is none


def test_rejects_offset_without_epsg(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="crs: offset_m needs epsg"):
        load(tmp_path, {"fcd": "f.csv"}, crs={"offset_m": [1, 2]})
    assert load(tmp_path, {"fcd": "f.csv"}, crs={"zero_height_m": 210.0}).crs.zero_height_m == 210.0


def test_rejects_damaged_location(tmp_path: Path) -> None:
    scene = load(tmp_path, with_location(tmp_path, UTM, "here"))
    with pytest.raises(InputError, match=r"n.net.xml: invalid <location>"):
        geolocation.scenario_georeference(scene)


def test_projections_of_sumo_give_no_frame() -> None:
    assert geolocation.network_world_frame(None) is None
    assert geolocation.network_world_frame(Location("-", (0.0, 0.0))) is None
    assert geolocation.network_world_frame(Location(UTM, (1.0, 2.0))) is not None
