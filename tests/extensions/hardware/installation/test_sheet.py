"""A sheet has the coordinates, bearings and tolerances of its sensor, and opens as one page."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shlex
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import egvs
from egvs.artefacts.run_folder import RunFolder
from egvs.export.export import export_run
from egvs.extensions.hardware.installation import sheet, view
from egvs.extensions.hardware.installation.planned_sites import PlannedSites
from egvs.extensions.hardware.installation.tolerances import QUANTITIES, Tolerance
from egvs.formats.georeference import WorldFrame
from egvs.sensors.sites import Pose
from tests.extensions.hardware.installation.conftest import InstalledRun, write_installed_scenario

UTM32 = WorldFrame("EPSG:25832", (-680_000.0, -5_400_000.0))


@pytest.fixture(scope="module")
def located(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a reference system and a plan."""
    folder = tmp_path_factory.mktemp("located")
    scenario = write_installed_scenario(folder / "crossing")
    text = (scenario / "scenario.toml").read_text()
    (scenario / "scenario.toml").write_text(f"{text}\n[crs]\nepsg = 25832\noffset_m = [-680000, -5400000]\n")
    loaded = egvs.load(scenario, ["placement.count=1"])
    egvs.run(loaded, folder / "run", jobs=1)
    egvs.place(loaded, folder / "run")
    return folder / "run"


def test_convergence_is_difference_of_longitude_by_sine_of_latitude() -> None:
    """First term of the series for the transverse Mercator projection (central meridian 9 degrees east)."""
    longitude, latitude = UTM32.to_degrees(np.array([[0.0, 0.0]]))[0]
    expected = (longitude - 9.0) * math.sin(math.radians(latitude))
    assert expected > 1.8
    assert sheet.meridian_convergence_deg(UTM32, (0.0, 0.0)) == pytest.approx(expected, abs=1e-3)


@pytest.mark.slow
def test_true_bearing_points_to_where_the_front_points(located: Path) -> None:
    planned = PlannedSites.open(located)
    (name,) = planned.default_sites
    data = sheet.sheet_data(planned, name)
    assert data.rank == "sensor 1 of the plan"
    assert planned.run.frame is not None
    ahead = math.radians(data.pose.yaw_deg)
    here = np.array([data.pose.x_m, data.pose.y_m])
    there = here + 10.0 * np.array([math.cos(ahead), math.sin(ahead)])
    (lon0, lat0), (lon1, lat1) = planned.run.frame.to_degrees(np.array([here, there])).tolist()
    east = math.radians(lon1 - lon0) * math.cos(math.radians(lat0)) * 6_388_000.0  # radii of curvature at 48.7 degrees
    north = math.radians(lat1 - lat0) * 6_371_500.0
    assert data.true_bearing_deg == pytest.approx(math.degrees(math.atan2(east, north)) % 360.0, abs=0.2)
    assert (data.easting_m, data.northing_m) == (here[0] + 680_000.0, here[1] + 5_400_000.0)
    assert data.lon_lat_deg == pytest.approx((lon0, lat0))
    assert data.crs.startswith("EPSG:25832 (ETRS89 / UTM zone 32N")


@pytest.mark.slow
def test_grid_bearing_and_angles_are_those_of_the_pose(installed: InstalledRun) -> None:
    data = sheet.sheet_data(installed.sites, "pole_a")
    assert data.grid_bearing_deg == 150.0  # yaw -60: from the x axis towards south
    assert data.mounting_height_m == 5.0
    rows = dict(data.orientation_rows)
    assert rows["Tilt of the front"] == "5.0° down"
    assert dict(data.position_rows)["x, y"] == "10.000 m, 12.000 m"
    assert data.rank.endswith("of 2 sites")


@pytest.mark.slow
def test_sensor_that_is_upside_down_is_described_as_it_hangs(installed: InstalledRun) -> None:
    """Its field of view is that in the world: the beams of the sensor that point up point down."""
    data = sheet.sheet_data(installed.sites, "pole_a")
    low_deg, high_deg = data.sensor.elevation_span_deg
    assert dict(data.orientation_rows)["Mount"] == "upright"
    site = replace(data.site, pose=replace(data.pose, roll_deg=-178.5))
    rows = dict(replace(data, site=site).orientation_rows)
    assert rows["Mount"] == "upside down, the base on top"
    assert rows["Roll"] == "1.5°, left side up"
    assert f"{-high_deg:+.0f}° to {-low_deg:+.0f}°" in rows["Field of view"]


def test_losses_name_the_direction() -> None:
    tilt = Tolerance(QUANTITIES[0], (-4.0, 0.0, 4.0), (1.62, 0.0, -0.7), 2.5, math.inf)
    assert sheet.describe_losses(tilt) == "4° down: -1.6, 4° up: +0.7 points"
    assert sheet.describe_limit(tilt) == "2.5 degrees"


@pytest.mark.slow
def test_sheet_is_one_page_with_picture_and_map(installed: InstalledRun, tmp_path: Path) -> None:
    ((data, path),) = sheet.write_sheets(installed.folder, ["pole_b"], kind="svg", out=tmp_path)
    root = ET.fromstring(path.read_text())
    size_mm = [float(root.attrib[name].removesuffix("mm")) for name in ("width", "height")]
    assert size_mm == pytest.approx([210.0, 297.0], abs=0.1)
    words = " ".join(element.text or "" for element in root.iter("{http://www.w3.org/2000/svg}text"))
    for part in (
        "Installation sheet: pole_b",
        "0.0° from grid north",
        "Tolerances",
        f"{data.tolerances.frames} frames",
    ):
        assert part in words
    assert path.read_text().count("data:image/png") >= 2


@pytest.mark.slow
@pytest.mark.system
def test_pdf_is_a4_and_the_same_each_time(installed: InstalledRun, tmp_path: Path) -> None:
    pytest.importorskip("cairosvg")
    for name in ("a", "b"):
        sheet.write_sheets(installed.folder, ["pole_a"], out=tmp_path / name)
    first, second = ((tmp_path / name / "installation_pole_a.pdf").read_bytes() for name in ("a", "b"))
    assert first == second
    assert first.startswith(b"%PDF")
    (box,) = set(re.findall(rb"/MediaBox \[ ([0-9. ]+) \]", first))
    assert [float(value) for value in box.split()] == pytest.approx([0, 0, 595.28, 841.89], abs=0.5)


def test_picture_shows_house_in_front_of_the_camera_and_sky_above(installed: InstalledRun) -> None:
    sites = installed.sites
    scene, site = sites.session.scene, sites.site("pole_a")
    narrow = replace(sites.sensor(site), azimuth_deg=(-30.0, 30.0))
    facing_north = Pose(20.0, -10.0, 5.0, 90.0)
    pixels = view.render_view(scene, facing_north, narrow, None, width=80, height=40).astype(int)
    assert pixels[0, 40].tolist() == list(view._COLOURS["sky"])  # the house ends 4 m above, at 26 m: 9 degrees
    red, _, blue = pixels[18, 40]
    assert red > blue  # the wall is brown
    ground = pixels[39, 0]
    assert ground[1] >= ground[0] > ground[2]


def test_camera_looks_along_the_middle_of_a_limited_field_of_view(installed: InstalledRun) -> None:
    sites = installed.sites
    site = sites.site("pole_a")
    sensor = replace(sites.sensor(site), azimuth_deg=(0.0, 60.0), elevations_deg=(-10.0, 0.0))
    camera = view.camera_pose(Pose(0.0, 0.0, 5.0, 20.0), sensor, sites.session.scene.roi)
    assert (camera.yaw_deg, camera.pitch_deg) == pytest.approx((50.0, -5.0))


@pytest.mark.slow
def test_default_is_the_plan_and_command_prints_tolerances(located: Path, run_egvs: Any, tmp_path: Path) -> None:
    code, printed, _ = run_egvs("sheets", located, "--format", "svg", "--out", tmp_path / "out")
    assert code == 0
    (name,) = PlannedSites.open(located).default_sites
    assert [path.name for path in (tmp_path / "out").iterdir()] == [f"installation_{name}.svg"]
    assert ": tilt " in printed
    assert "(40 frames)" in printed


@pytest.fixture(scope="module")
def spaced(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with two mounts on each of two poles whose names have a space, of a map with a maker, with a plan."""
    folder = tmp_path_factory.mktemp("spaced")
    scenario = write_installed_scenario(folder / "crossing")
    file = scenario / "scenario.toml"
    file.write_text(file.read_text().replace("[sites]", "[sites]\nheights_m = [4, 5]", 1))
    rows = "Ampel Nord,10,12,-60,-5\nMast West,30.5,-12,90,0\n"
    (scenario / "sites.csv").write_text(f"site,x_m,y_m,yaw_deg,pitch_deg\n{rows}")
    solids = scenario / "statics.geojson"
    head = '{"attribution": "(c) OpenStreetMap contributors, ODbL",'
    solids.write_text(solids.read_text().replace("{", head, 1))
    loaded = egvs.load(scenario, ["placement.count=2", "placement.most_per_pole=1"])
    egvs.run(loaded, folder / "run", jobs=1)
    egvs.place(loaded, folder / "run")
    return folder / "run"


def sheet_text(path: Path) -> str:
    root = ET.fromstring(path.read_text(encoding="utf-8"))
    return " ".join(element.text or "" for element in root.iter("{http://www.w3.org/2000/svg}text"))


@pytest.mark.slow
def test_sheets_of_a_dropped_mast_are_removed(spaced: Path, run_egvs: Any, tmp_path: Path) -> None:
    """A crew that finds an old sheet would mount what is no longer planned. A sheet that somebody changed stays."""
    scenario = spaced.parent / "crossing"
    run_egvs("sheets", spaced, "--format", "svg")
    both = {path.name for path in (spaced / "sheets").iterdir()}
    assert len(both) == 2
    (spaced / "sheets" / "notes.txt").write_text("ours")
    egvs.place(egvs.load(scenario, ["placement.excluded=['Mast West']", "placement.count=1"]), spaced)
    assert "installation_Mast_West" not in (spaced / "report.html").read_text()
    code, printed, _ = run_egvs("sheets", spaced, "--format", "svg")
    (kept,) = {name for name in both if "Ampel" in name}
    (dropped,) = both - {kept}
    assert (code, {path.name for path in (spaced / "sheets").iterdir()}) == (0, {kept, "notes.txt"})
    assert f"removed, because they were of an earlier plan: {dropped}." in " ".join(printed.split())

    (spaced / "sheets" / kept).write_text("<svg>with a note</svg>")
    egvs.place(egvs.load(scenario, ["placement.excluded=['Ampel Nord']", "placement.count=1"]), spaced)
    code, printed, _ = run_egvs("sheets", spaced, "--format", "svg")
    assert (code, (spaced / "sheets" / kept).is_file()) == (0, True)
    assert "of an earlier plan, but changed since" in printed
    egvs.place(egvs.load(scenario, ["placement.count=2", "placement.most_per_pole=1"]), spaced)


@pytest.mark.slow
def test_sheet_in_another_format_or_folder_is_one_more(spaced: Path, run_egvs: Any, tmp_path: Path) -> None:
    scenario = spaced.parent / "crossing"
    places = (spaced / "sheets", "svg"), (spaced / "more", "svg"), (spaced / "more", "pdf")
    for folder, kind in places:
        printed = run_egvs("sheets", spaced, "--format", kind, "--out", folder)[1]
        assert "removed" not in printed
    assert [len(list(folder.glob(f"*.{kind}"))) for folder, kind in places] == [2, 2, 2]
    egvs.place(egvs.load(scenario, ["placement.excluded=['Mast West']", "placement.count=1"]), spaced)
    run_egvs("sheets", spaced, "--format", "svg", "--out", spaced / "sheets")
    assert [len(list(folder.glob(f"*.{kind}"))) for folder, kind in places] == [1, 1, 1]
    egvs.place(egvs.load(scenario, ["placement.count=2", "placement.most_per_pole=1"]), spaced)


@pytest.mark.slow
def test_sheet_of_a_candidate_is_not_removed_with_those_of_a_plan(spaced: Path, tmp_path: Path) -> None:
    for height in (4, 5):
        sheet.write_sheets(spaced, [f"Mast West@{height}m"], kind="svg", out=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


def test_record_of_sheets_leads_to_no_other_file(tmp_path: Path) -> None:
    """A record may come with a run from somebody else."""
    run_folder, folder = RunFolder(tmp_path / "run"), tmp_path / "run" / "sheets"
    folder.mkdir(parents=True)
    entries = {}
    for path in ("installation_outside.svg", "run/notes.svg", "run/sheets/installation_own.svg"):
        (tmp_path / path).write_text("text")
        at = os.path.relpath(tmp_path / path, run_folder.path)
        entries[path] = {"path": at, "file": "x", "sha256": hashlib.sha256(b"text").hexdigest()}
    entries["by file"] = {**entries["installation_outside.svg"], "path": None, "file": "../../installation_outside.svg"}
    notes = list(sheet._remove_sheets(entries, run_folder, folder, []))
    assert notes == ["removed, because they were of an earlier plan: installation_own.svg."]
    assert sorted(path.name for path in tmp_path.rglob("*.svg")) == ["installation_outside.svg", "notes.svg"]


@pytest.mark.slow
def test_site_may_be_a_pole(spaced: Path, run_egvs: Any, tmp_path: Path) -> None:
    planned = next(name for name in PlannedSites.open(spaced).plan if name.startswith("Ampel Nord@"))
    code, printed, _ = run_egvs("sheets", spaced, "--site", "Ampel Nord", "--format", "svg", "--out", tmp_path)
    assert (code, printed.startswith(planned)) == (0, True)


@pytest.mark.slow
def test_command_is_quoted_and_maker_of_map_is_named(spaced: Path, tmp_path: Path) -> None:
    ((data, path),) = sheet.write_sheets(spaced, ["Mast West"], kind="svg", out=tmp_path)
    words = shlex.split(re.search("egvs accept .*? measured.pcd", sheet_text(path))[0])  # type: ignore[index]
    assert words == ["egvs", "accept", "RUN", "--site", data.site.name, "--scan", "measured.pcd"]
    assert "Map data (c) OpenStreetMap contributors, ODbL" in sheet_text(path)
    assert "Orange: the sensor, its field of view (30 m of 100 m) and its front (arrow)" in sheet_text(path)
    (exported, *_), notes = (result := export_run(spaced, "geojson", out=tmp_path / "geojson")).paths, result.notes
    assert json.loads(exported.read_text())["attribution"] == "(c) OpenStreetMap contributors, ODbL"
    assert any("OpenStreetMap contributors" in note for note in notes)


def test_rejects_unknown_site_and_format(installed: InstalledRun, run_egvs: Any, tmp_path: Path) -> None:
    for words, message in (
        (("--site", "pole_a", "--site", "nowhere"), "no pole or site 'nowhere'. Choose one of pole_a, pole_b."),
        (("--format", "gif"), "--format: expected one of pdf, svg, got 'gif'"),
    ):
        code, _, errors = run_egvs("sheets", installed.folder, *words, "--out", tmp_path / "out")
        assert (code, message in errors) == (2, True), errors
    assert not (tmp_path / "out").exists()
    code, _, errors = run_egvs("sheets", tmp_path)
    assert (code, "run.json" in errors) == (2, True)
