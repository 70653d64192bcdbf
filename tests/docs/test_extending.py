"""The packages of docs/extending.md do what the page says: each is installed beside the program, as one of somebody
else's would be, and used by name."""

from __future__ import annotations

import json
import math
import re
import tomllib
from pathlib import Path

import pytest
from pyproj import Transformer

import egvs
from tests import processes

PAGE = Path(__file__).resolve().parents[2] / "docs" / "extending.md"
SMALL = Path(__file__).resolve().parents[1] / "creation" / "data" / "small.osm"
_FILE = re.compile(r"^\[`([^`]+)`\]\((examples/[^)]+)\)$", re.MULTILINE)
_LINES = 35  # what a page of thirty lines may come to
_CODE_LINES = 30


def package(heading: str) -> dict[str, str]:
    """The files of the example that the page shows under one heading, by name."""
    part = re.search(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.M)
    assert part, f"{PAGE.name} has no heading {heading!r}"
    return {name: (PAGE.parent / path).read_text(encoding="utf-8") for name, path in _FILE.findall(part[1])}


def install(files: dict[str, str], folder: Path) -> Path:
    """What an installer makes of a package: its modules, and its metadata with the entry points."""
    project = tomllib.loads(files["pyproject.toml"])["project"]
    about = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    groups = (
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in entries.items())
        for group, entries in project["entry-points"].items()
    )
    (about / "entry_points.txt").write_text("\n".join(groups))
    for name, text in files.items():
        if name != "pyproject.toml":
            (folder / name).write_text(text)
    return folder


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal that breaks no line."""
    monkeypatch.setenv("COLUMNS", "200")


def run_egvs(*arguments: object, beside: Path) -> tuple[int, str]:
    """The command line in a process of its own that sees the folder ``beside``: exit code, and all that it prints."""
    done = processes.run_egvs(*arguments, beside=beside)
    return done.returncode, done.stdout + done.stderr


def scores(folder: Path) -> list[float]:
    return list(egvs.read_scores(folder / "scores.parquet").column("egvs").to_pylist())


@pytest.mark.parametrize(
    ("heading", "n_modules"),
    [
        ("An effect", 1),
        ("A map format", 2),
        ("A format of point clouds", 2),
        ("A format of recorded tracks", 2),
        ("A score", 1),
        ("A score that ranks", 1),
        ("A command", 1),
        ("A section of the report", 1),
    ],
)
def test_the_example_is_short(heading: str, n_modules: int) -> None:
    modules = [text for name, text in package(heading).items() if name.endswith(".py")]
    assert len(modules) == n_modules
    assert max(len(text.splitlines()) for text in modules) <= _LINES
    lines = [line for text in modules for line in text.splitlines() if line.strip()]
    assert len(lines) <= _CODE_LINES


@pytest.mark.slow
@pytest.mark.system
def test_an_effect_of_another_package_acts(mini: Path, tmp_path: Path) -> None:
    beside = install(package("An effect"), tmp_path / "installed")

    def run(out: str, *settings: str) -> list[float]:
        code, text = run_egvs("run", mini, "--out", tmp_path / out, *settings, beside=beside)
        assert code == 0, text
        return scores(tmp_path / out)

    plain = run("plain")
    assert run("near", "--set", "effects.blind_zone.nearest_m=0.001") == plain  # its limit: nothing is that near
    thinned = run("far", "--set", "effects.blind_zone.nearest_m=15")
    assert all(0 < less < score for less, score in zip(thinned, plain, strict=True))


@pytest.mark.slow
@pytest.mark.system
def test_an_effect_of_another_package_is_listed_and_checked(mini: Path, tmp_path: Path) -> None:
    beside = install(package("An effect"), tmp_path / "installed")
    code, text = run_egvs("effects", beside=beside)
    assert code == 0 and "blind_zone" in text and "the sensor's datasheet" in text
    code, text = run_egvs(
        "run", mini, "--out", tmp_path / "out", "--set", "effects.blind_zone.nearest=1", beside=beside
    )
    assert code == 2 and "effects.blind_zone" in text and "nearest_m" in text, text
    code, text = run_egvs(
        "run", mini, "--out", tmp_path / "out", "--set", "effects.blind_zone.nearest_m=1", beside=tmp_path
    )
    assert code == 2 and "unknown effect" in text, text


@pytest.mark.slow
@pytest.mark.system
def test_a_map_format_of_another_package_is_read(tmp_path: Path) -> None:
    """A wall of 20 m and 2.5 m height beside the junction of the test's extract, and one far away."""
    beside = install(package("A map format"), tmp_path / "installed")
    east_m, north_m = Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True).transform(10.0, 52.0)
    rows = [(east_m + 40 + far, north_m + 25, east_m + 60 + far, north_m + 25, 2.5) for far in (0, 50_000)]
    (tmp_path / "site.walls").write_text("".join(" ".join(map(str, row)) + "\n" for row in rows))
    code, text = run_egvs("new", tmp_path / "made", "--from", SMALL, tmp_path / "site.walls", beside=beside)
    assert code == 0 and "wall list" in text, text
    statics = json.loads((tmp_path / "made" / "statics.geojson").read_text())
    (wall,) = (f for f in statics["features"] if f["properties"]["name"].startswith("site/"))
    assert wall["properties"]["height_m"] == 2.5
    (x0, y0), (x1, y1) = wall["geometry"]["coordinates"]
    assert math.hypot(x1 - x0, y1 - y0) == pytest.approx(20, abs=0.05)
    code, text = run_egvs("new", tmp_path / "other", "--from", SMALL, tmp_path / "site.walls", beside=tmp_path)
    assert code == 2 and "site.walls: the format of the file is unknown" in text and "OpenStreetMap" in text, text


@pytest.mark.slow
@pytest.mark.system
def test_a_package_with_a_former_group_gets_one_message(tmp_path: Path) -> None:
    files = package("A map format")
    files["pyproject.toml"] = files["pyproject.toml"].replace("egvs.readers", "egvs.maps")
    beside = install(files, tmp_path / "installed")
    code, text = run_egvs("new", tmp_path / "made", "--from", SMALL, beside=beside)
    assert code != 0 and "Traceback" not in text
    assert "the group egvs.maps is now egvs.readers" in text and "of the package egvs-walls" in text


@pytest.mark.slow
@pytest.mark.system
def test_a_format_of_another_package_is_read(mini: Path, tmp_path: Path) -> None:
    beside = install(package("A format of point clouds"), tmp_path / "installed")
    points = ("20 -2 0.5", "30 2.25 1", "nan nan nan", "25 0.125 0")
    (mini / "scan.xyz").write_text("\n".join(points) + "\n")
    (mini / "scan.csv").write_text("\n".join(["x_m,y_m,z_m", *(line.replace(" ", ",") for line in points)]) + "\n")

    def run(cloud: str) -> list[float]:
        (mini / "sites.csv").write_text(f"site,x_m,y_m,z_m,points\npole_a,10,12,3,{cloud}\n")
        code, text = run_egvs("run", mini, "--out", tmp_path / cloud, beside=beside)
        assert code == 0, text
        return scores(tmp_path / cloud)

    assert run("scan.xyz") == run("scan.csv")
    (mini / "scan.xyz").write_text("1 2\n")
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,points\npole_a,10,12,3,scan.xyz\n")
    code, text = run_egvs("run", mini, "--out", tmp_path / "wrong", beside=beside)
    assert code == 2 and "expected 3 numbers per line, got 2" in text, text


@pytest.mark.slow
@pytest.mark.system
def test_a_format_of_another_package_is_written(tmp_path: Path) -> None:
    beside = install(package("A format of point clouds"), tmp_path / "installed")
    code = """
import sys, numpy as np, pathlib
from egvs.formats.point_clouds import read_points, write_points
points = np.array([[1 / 3, -2e5, 1e-17], [0.1, 2.0, 3.0]])
path = pathlib.Path(sys.argv[1])
write_points(path, points)
read, dropped = read_points(path, "here")
assert dropped == 0 and read.tobytes() == points.tobytes()
"""
    done = processes.python(code, tmp_path / "scan.xyz", beside=beside)
    assert done.returncode == 0, done.stderr


@pytest.mark.system
def test_a_format_of_tracks_of_another_package_is_read(tmp_path: Path) -> None:
    """A car at 10 m, 20 m that heads east, beside the program's own formats."""
    beside = install(package("A format of recorded tracks"), tmp_path / "installed")
    code = """
import math, sys, pathlib
from egvs.extensions.tracks import sources
path = pathlib.Path(sys.argv[1])
reader = sources.find_reader(path)
assert reader.__name__ == "egvs_radar_tracks"
assert {"radar tracks", "SinD tracks"} <= set(sources.describe_formats().split(", "))
tracks = reader.read(path)
assert tracks.names == ("7",) and tracks.classes == ("car",) and tracks.frame.offset_m == (5e5, 5.6e6)
box = [float(column[0]) for column in (tracks.time_s, tracks.x_m, tracks.y_m, tracks.yaw_rad, tracks.length_m)]
assert all(math.isclose(a, b, abs_tol=1e-9) for a, b in zip(box, (1.5, 10, 20, 0, 4.5), strict=True)), box
assert math.isnan(tracks.width_m[0])
"""
    path = tmp_path / "tracks.csv"
    path.write_text("track,kind,x_cm,y_cm,stamp_ms,azimuth_deg,length_cm\n7,PKW,1000,2000,1500,90,450\n")
    done = processes.python(code, path, beside=beside)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.system
def test_a_score_of_another_package_is_listed(tmp_path: Path) -> None:
    beside = install(package("A score"), tmp_path / "installed")
    code, text = run_egvs("scores", beside=beside)
    assert code == 0 and "near_points" in text and "within_m 20, 50" in text and "package egvs-near-points" in text, (
        text
    )


@pytest.mark.slow
@pytest.mark.system
def test_a_score_of_another_package_ranks(mini: Path, tmp_path: Path) -> None:
    beside = install(package("A score that ranks"), tmp_path / "installed")
    words = ("--out", tmp_path / "run", "--set", "score.rank_by=half_seen")
    code, text = run_egvs("run", mini, *words, beside=beside)
    assert code == 0 and "half_seen" in text, text
    code, text = run_egvs("scores", beside=beside)
    assert code == 0 and "package egvs-half-seen" in text, text


@pytest.mark.system
def test_a_detector_of_another_package_detects(tmp_path: Path) -> None:
    beside = install(package("A detector"), tmp_path / "installed")
    code = """
import numpy as np
from egvs.core.grid import Roi
from egvs.sensors.sensor import CATALOGUE
from egvs.sensors.sites import Pose
from egvs.extensions.validation.detectors import base
from egvs.clouds.sweeps import SiteView, Sweep
assert "middle" in base.detector_names(), base.detector_names()
sensor = CATALOGUE["VLP-32C"]
view = SiteView("s", Pose(1.0, 2.0, 3.0), sensor, np.full(sensor.beams, 50.0))
ready = base.make_detector("middle").at_site(view, Roi((0.0, 0.0, 0.0), (9.0, 9.0, 9.0)))
beam = np.arange(3, dtype=np.uint32)
far = np.array([10.0, 10.0, 50.0])  # the last is background
points = np.column_stack([sensor.directions()[beam] * far[:, None], np.ones(3)]).astype(np.float32)
found = ready.detect(Sweep(points, beam))
np.testing.assert_allclose(found.boxes[0, :3], points[:2, :3].mean(axis=0) + (1, 2, 3), atol=1e-5)
assert found.scores.tolist() == [2.0]
assert ready.detect(Sweep(points[:0], beam[:0])).boxes.shape == (0, 7)
"""
    done = processes.python(code, beside=beside)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.system
def test_a_command_and_a_section_of_other_packages_work(mini: Path, tmp_path: Path) -> None:
    beside = install(package("A command"), tmp_path / "installed")
    install(package("A section of the report"), beside)
    out = tmp_path / "out"

    code, text = run_egvs("visit", out, beside=beside)
    assert code == 2 and "there are no scores in this folder. Run egvs run first." in text
    code, text = run_egvs("run", mini, "--out", out, beside=beside)
    assert code == 0 and "The visit contradicts" not in text, text
    code, text = run_egvs("visit", out, "--sites", "1", beside=beside)
    assert code == 0 and re.fullmatch(r"pole_[ab]: x -?[\d.]+ m, y -?[\d.]+ m\n", text), text
    best = text.partition(":")[0]
    assert "visit" in run_egvs("--help", beside=beside)[1]

    (out / "visits.txt").write_text(f"{best}: impossible, a <gas> main\n")
    code, text = run_egvs("run", mini, "--out", out, beside=beside)
    assert code == 0 and f"The visit contradicts the ranking: no sensor can stand at {best}." in text, text
    page = (out / "report.html").read_text()
    assert f"<p><b>{best}</b>: impossible, a &lt;gas&gt; main</p>" in page
    assert f'No sensor can stand at {best}: see the <a href="#visits">visit</a>.' in page
