"""What is exported and read again is the same scene, on a hill too: the file says where its heights count from.

The road rises from z = 96 m to 108 m, so reading heights above the ground as heights of the world frame, or the other
way round, moves solids and sensors by about 100 m.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest

from egvs import load
from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.export.export import export_run
from egvs.formats import point_clouds
from egvs.runs import run
from egvs.scenario.model import Scenario
from egvs.sensors.sites import candidate_sites
from egvs.stages.inputs import Inputs
from egvs.studies.assumed_heights import scale_heights
from egvs.studies.what_if import solid_documents
from egvs.world.mesh import World
from tests.conftest import collection, feature, write_mini
from tests.export.conftest import EPSG, OFFSET_M
from tests.stages.conftest import net_xml

Call = Callable[..., tuple[int, str, str]]

LANES = """\
  <edge id="east" from="a" to="b">
    <lane id="east_0" index="0" length="120" width="4.00" shape="-40,-2,96 80,-2,108"/>
  </edge>
  <edge id="west" from="b" to="a">
    <lane id="west_0" index="0" length="120" width="4.00" shape="80,2,108 -40,2,96"/>
  </edge>
"""
"""The road of the cars, 10 % steep: z = 100 + x / 10."""

POLES = {"pole_a": (10.0, 12.0, 104.5), "pole_b": (30.5, -12.0, 106.0)}
"""Positions of the sensors, about 3 m above the ground."""


def write_hill(folder: Path) -> Path:
    """The scenario that all tests share, on a road with a grade."""
    scenario = write_mini(folder)
    text = (scenario / "scenario.toml").read_text()
    low = "center_m = [20, 0, 2.5]\nsize_m = [40, 20, 5]"
    assert low in text and 'fcd = "fcd.csv"\n' in text
    text = text.replace(low, "center_m = [20, 0, 102.5]\nsize_m = [40, 20, 11]")
    text = text.replace('fcd = "fcd.csv"\n', 'fcd = "fcd.csv"\nroads = "net.net.xml"\n')
    text += f"\n[crs]\nepsg = {EPSG}\noffset_m = [{OFFSET_M[0]}, {OFFSET_M[1]}]\n"
    (scenario / "scenario.toml").write_text(text)
    (scenario / "net.net.xml").write_text(net_xml(LANES))
    header, *rows = (scenario / "fcd.csv").read_text().splitlines()
    lifted = [f"{row};{100 + float(row.split(';')[2]) / 10:.4f}" for row in rows]
    (scenario / "fcd.csv").write_text("\n".join([f"{header};vehicle_z", *lifted]) + "\n")
    rows = [f"{name},{x},{y},{z}" for name, (x, y, z) in POLES.items()]
    (scenario / "sites.csv").write_text("\n".join(["site,x_m,y_m,z_m", *rows]) + "\n")
    return scenario


@pytest.fixture(scope="module")
def hill(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a scenario on a hill; its run is in the folder ``run`` in it."""
    scenario = write_hill(tmp_path_factory.mktemp("hill") / "mini")
    run.run(load(scenario), scenario / "run")
    return scenario


def solids(scenario: Scenario) -> dict[str, tuple[float, float, float]]:
    """Area, underside and top of each solid of a scenario, by name, in z of the world frame."""
    world: World = Inputs(scenario).world
    extents = {}
    for number, (name, kind) in enumerate(world.solids):
        if kind != "ground":
            corners = world.triangles_m[world.solid_of_face == number]
            sides = corners[:, 1:, :2] - corners[:, :1, :2]
            area = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]).sum() / 4.0
            extents[name] = (float(area), float(corners[:, :, 2].min()), float(corners[:, :, 2].max()))
    return extents


def one_layer(exported: Path, layer: str, path: Path) -> Path:
    """Save a layer of a file with several in a file of its own, as a GIS does."""
    import pyogrio

    frame = pyogrio.read_dataframe(exported, layer=layer)
    pyogrio.write_dataframe(frame, path, driver="LIBKML" if path.suffix == ".kml" else "GPKG", layer=layer)
    return path


def exported_layer(run_folder: Path, to: str, crs: str, layer: str, out: Path) -> Path:
    """A layer of a run in a file of its own."""
    suffix = {"geoparquet": "parquet"}.get(to, to)
    if to in ("gpkg", "kml"):
        pytest.importorskip("pyogrio", reason="the extra egvs[gis] is not installed")
        export_run(run_folder, to, crs=None if to == "kml" else crs, out=out / f"all.{suffix}")
        return one_layer(out / f"all.{suffix}", layer, out / f"{layer}.{suffix}")
    if to == "geoparquet":
        pytest.importorskip("geopandas", reason="the extra egvs[gis] is not installed")
    export_run(run_folder, to, crs=crs, out=out)
    path = out / f"{layer}.{suffix}"
    if (to, crs) == ("geojson", "wgs84"):  # RFC 7946 has no member "crs", so the user has to declare it
        declared = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
        path.write_text(json.dumps(json.loads(path.read_text()) | {"crs": declared}))
    return path


FOOTPRINT_FORMATS = [
    ("geojson", "scenario"), ("geojson", "wgs84"), ("geoparquet", "scenario"), ("geoparquet", "wgs84"),
    ("gpkg", "scenario"), ("gpkg", "wgs84"), ("kml", "wgs84"),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize(("to", "crs"), FOOTPRINT_FORMATS)
def test_exported_footprints_are_the_same_solids(hill: Path, tmp_path: Path, to: str, crs: str) -> None:
    path = exported_layer(hill / "run", to, crs, "footprints", tmp_path)
    actual = solids(load(hill, [f'statics.footprints=["{path}"]']))
    expected = solids(load(hill))
    assert actual.keys() == expected.keys() == {"house", "lamp"}
    for name, extent in expected.items():
        assert actual[name] == pytest.approx(extent, abs=0.01)
    assert expected["house"][2] == pytest.approx(107.6, abs=0.05)  # 6 m above the ground at x = 16


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize(("to", "crs"), [*FOOTPRINT_FORMATS, ("csv", "scenario"), ("csv", "wgs84")])
def test_exported_sites_are_the_same_sensors(hill: Path, tmp_path: Path, to: str, crs: str) -> None:
    path = exported_layer(hill / "run", to, crs, "sites", tmp_path)
    actual = {site.name: site.pose for site in candidate_sites(load(hill, [f"sites.file={path}"]))}
    assert {name: pose.position_m for name, pose in actual.items()} == {
        name: pytest.approx(position, abs=0.01) for name, position in POLES.items()
    }


@pytest.mark.system
def test_statics_of_a_run_are_the_same_solids_as_a_mesh(hill: Path) -> None:
    scenario = load(hill, ["statics.footprints=[]", 'statics.meshes=[{file="run/statics.ply"}]'])
    expected = sorted(solids(load(hill)).values())
    closed = [extent for name, extent in solids(scenario).items() if not name.endswith("_surface")]
    assert sorted(closed) == [pytest.approx(extent, abs=0.01) for extent in expected]


def test_exported_scene_is_no_mesh_of_a_scenario(hill: Path, tmp_path: Path) -> None:
    """Its y axis points up, and it contains the sensors and the ground."""
    export_run(hill / "run", "glb", out=tmp_path)
    scenario = load(hill, [f'statics.meshes=[{{file="{tmp_path / "scene.glb"}"}}]'])
    with pytest.raises(InputError, match=r"scene\.glb: is the exported scene of a run, .*Use statics\.ply of that run"):
        Inputs(scenario).built_world  # noqa: B018


@pytest.mark.system
def test_simulated_scan_is_in_the_frame_of_measured_ones(hill: Path, tmp_path: Path, run_egvs: Call) -> None:
    scenario = shutil.copytree(hill, tmp_path / "again")
    code, _, _ = run_egvs("scan", scenario, "--out", scenario / "run", "--points", "pole_a")
    assert code == 0
    points_m, _ = point_clouds.read_points(scenario / "run" / "scan_pole_a.ply", "points")
    scans = parquet.read_artefact(scenario / "run" / "scans.parquet", "scans")[0]
    hits = scans.filter(pc.and_(pc.equal(scans["site"], "pole_a"), scans["returned"]))
    expected = np.column_stack([hits[name].to_numpy() for name in ("dx_m", "dy_m", "dz_m")]) + POLES["pole_a"]
    assert np.sort(points_m, axis=0) == pytest.approx(np.sort(expected, axis=0), abs=0.001)


# --- what files say, by hand


def test_z_datum_tells_where_heights_count_from(hill: Path, tmp_path: Path) -> None:
    square = {"type": "Polygon", "coordinates": [[[14, 5], [18, 5], [18, 8], [14, 8], [14, 5]]]}
    above = feature(square, name="a", height_m=6)
    file = tmp_path / "s.geojson"
    tops = {}
    for datum in ("ground", "world"):
        height_m = 6 if datum == "ground" else 107.6
        stated = feature(square, name="a", height_m=height_m, base_m=height_m - 6, z_datum=datum)
        file.write_text(collection(stated))
        tops[datum] = solids(load(hill, [f'statics.footprints=["{file}"]']))["a"][2]
    file.write_text(collection(above))
    tops["default"] = solids(load(hill, [f'statics.footprints=["{file}"]']))["a"][2]
    assert tops == dict.fromkeys(("ground", "world", "default"), pytest.approx(107.6, abs=0.01))


@pytest.mark.parametrize(
    ("properties", "message"),
    [
        ({"z_datum": "sea level"}, r"z_datum: expected 'ground' or 'world', got 'sea level'"),
        ({"z_datum": 0}, r"z_datum: expected 'ground' or 'world', got 0"),
        ({"Z_Datum": "world"}, r"unknown property 'Z_Datum'. Did you mean z_datum"),
    ],
)
def test_rejects_other_z_datum(hill: Path, tmp_path: Path, properties: dict, message: str) -> None:
    square = {"type": "Polygon", "coordinates": [[[14, 5], [18, 5], [18, 8], [14, 8], [14, 5]]]}
    (tmp_path / "s.geojson").write_text(collection(feature(square, name="a", height_m=6, **properties)))
    with pytest.raises(InputError, match=message):
        Inputs(load(hill, [f'statics.footprints=["{tmp_path / "s.geojson"}"]'])).built_world  # noqa: B018


@pytest.mark.slow
@pytest.mark.system
def test_altitude_in_kml_is_above_the_ground(hill: Path, tmp_path: Path) -> None:
    """Google Earth shows a sensor at its altitude above the terrain; ``z_m`` is that of the world frame."""
    pytest.importorskip("pyogrio", reason="the extra egvs[gis] is not installed")
    export_run(hill / "run", "kml", out=tmp_path / "run.kml")
    text = (tmp_path / "run.kml").read_text()
    sites = text[text.index("<name>sites</name>") : text.index("</Folder>")]
    altitudes = [float(line.split(",")[2].partition("<")[0]) for line in sites.splitlines() if "<coordinates>" in line]
    assert altitudes == pytest.approx([104.5 - 101.0, 106.0 - 103.05], abs=0.05)

    point = "<Point><altitudeMode>relativeToGround</altitudeMode><coordinates>{}</coordinates></Point>"
    lon_lat = next(line for line in sites.splitlines() if "<coordinates>" in line).split(">")[1].split("<")[0]
    mark = f"<Placemark><name>p</name>{point.format(lon_lat)}</Placemark>"
    (tmp_path / "p.kml").write_text(f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{mark}</Document></kml>')
    with pytest.raises(InputError, match=r"p\.kml: site p: expected the field z_m, since the ground is not at z = 0"):
        candidate_sites(load(hill, [f"sites.file={tmp_path / 'p.kml'}"]))


def test_assumed_heights_in_z_of_the_world_are_scaled_from_their_underside() -> None:
    def scaled(**properties: object) -> list[float]:
        square = {"type": "Polygon", "coordinates": [[[14, 5], [18, 5], [18, 8], [14, 8], [14, 5]]]}
        one = feature(square, kind="building", height_from="default", **properties)
        changed = scale_heights(json.loads(collection(one)), 1.5)["features"][0]["properties"]
        return [changed["base_m"], changed["height_m"]]

    assert scaled(base_m=0, height_m=6) == [0, 9]
    assert scaled(base_m=101, height_m=107, z_datum="world") == [101, 110]


def test_rejects_growth_of_trees_in_z_of_the_world(hill: Path, tmp_path: Path) -> None:
    square = {"type": "Polygon", "coordinates": [[[14, 5], [18, 5], [18, 8], [14, 8], [14, 5]]]}
    tree = feature(square, name="a", kind="tree_crown", height_m=108, base_m=104, z_datum="world")
    (tmp_path / "s.geojson").write_text(collection(tree))
    settings = [
        f'statics.footprints=["{tmp_path / "s.geojson"}"]',
        "what_if.grown.share=1",
        "what_if.grown.tree_scale=2",
    ]
    with pytest.raises(InputError, match=r"what_if\.grown\.tree_scale: expected trees with heights above the ground"):
        solid_documents(load(hill, settings), "grown")
