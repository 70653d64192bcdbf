"""Each row of the table of limits by format (docs/security.md) is tried.

A small file is read; then each limit of the row is lowered through its variable, and the same file, or one that is just
too large, is refused with a message that names the limit and the variable.
"""

from __future__ import annotations

import gzip
import json
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet as pq
import pytest

from egvs.core import limits, reading
from egvs.core.errors import EgvsError
from egvs.formats import meshes, osm, point_clouds, reader_process, spreadsheets, vector_files, xml
from egvs.traffic import fcd, user_files
from egvs.traffic.user_files import DemandFiles
from egvs.world import footprints
from tests.docs.pages import DOCS, ROOT
from tests.formats import foreign_files
from tests.formats.test_e57 import ONE_POINT, write_e57
from tests.formats.test_osm import pbf_of
from tests.formats.test_point_clouds import las
from tests.formats.test_small_files_that_grow import geoparquet
from tests.formats.workbooks import write_xlsx
from tests.installed import EXTENSIONS, needs

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux limits the memory of a process"),
    needs(*EXTENSIONS),
]


def table_rows() -> dict[str, list[str]]:
    """The variables of each format, from the page."""
    page = (DOCS / "security.md").read_text(encoding="utf-8")
    table = page.partition("| format | read by | limits |\n")[2].partition("\n\n")[0]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[1:]]
    return {row[0].replace("`", ""): row[2].replace("`", "").split(", ") for row in cells}


@dataclass(frozen=True)
class Trial:
    """A format.

    Attributes
    ----------
    name
        Name of the file.
    write
        Writes a valid file; given a number of MB, one of at least that size.
    read
        Reads it.
    lowered
        Value of each variable that refuses a file of 1.2 MB, or the small one if it counts something else.
    """

    name: str
    write: Callable[[Path, float], None]
    read: Callable[[Path], object]
    lowered: dict[str, int] = field(default_factory=dict)


def text(content: str, padding: str = "\n") -> Callable[[Path, float], None]:
    """A text, and padding behind it."""
    return lambda path, mb: path.write_text(content + padding * int(mb * 1e6 / len(padding)))  # type: ignore[return-value]


def padded(write: Callable[[Path], object]) -> Callable[[Path, float], None]:
    """A file, and zeros behind it: its size is compared before anything else."""

    def make(path: Path, mb: float) -> None:
        write(path)
        with path.open("ab") as file:
            file.write(bytes(int(mb * 1e6)))

    return make


def write_fcd(path: Path, mb: float) -> None:
    numbers = np.arange(100 + mb * 40_000)
    names = ["a"] * len(numbers)
    pq.write_table(
        pa.table({"time": numbers, "id": names, "x": numbers, "y": numbers, "angle": numbers, "type": names}), path
    )


def write_feather(path: Path, mb: float) -> None:
    table = pa.table({"track_uuid": ["a", "b"], "x": [1.0, 2.0]})
    if mb:
        table = pa.concat_tables([table] * int(mb * 60_000))
    pyarrow.feather.write_feather(table.combine_chunks(), path, compression="uncompressed")


def read_feather(path: Path) -> object:
    from egvs.extensions.tracks.formats.arrow_tables import ArrowTable

    return ArrowTable(path, ["track_uuid"], ["x"]).numbers("x")


def read_track_table(path: Path) -> object:
    from egvs.extensions.tracks import columns

    return columns.read_table(path, ["id", "x"])


def write_glb(path: Path) -> None:
    import trimesh

    trimesh.creation.box().export(path)


def write_scans(path: Path) -> None:
    scan = (ONE_POINT, [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    write_e57(path, scan, scan)


def write_geotiff(path: Path) -> None:
    rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed (egvs[gis])")
    profile = {"driver": "GTiff", "width": 4, "height": 3, "count": 1, "dtype": "float32", "crs": "EPSG:25832"}
    with rasterio.open(path, "w", transform=rasterio.transform.from_origin(0, 3, 1, 1), **profile) as file:
        file.write(np.ones((1, 3, 4), np.float32))


def padded_geotiff(path: Path, mb: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PendingDeprecationWarning)  # by rasterio, of affine
        padded(write_geotiff)(path, mb)


def read_geotiff(path: Path) -> object:
    from egvs.extensions.maps.formats import rasters

    return rasters.read_geotiff_header(path)


def read_ascii_grid(path: Path) -> object:
    from egvs.extensions.maps.formats import rasters

    return rasters.read_ascii_grid(path)


def write_npz(path: Path, mb: float) -> None:
    angles = np.linspace(0.0, 100.0, 3000 + int(mb * 45_000))
    np.savez_compressed(path, a=np.column_stack([9 * np.cos(angles), 9 * np.sin(angles), np.sin(7 * angles)]))


def read_npz(path: Path) -> object:
    from egvs.formats.sweep_files import read_sweeps

    return read_sweeps([path])


def read_polygon(path: Path) -> object:
    feature = reading.read_json(path)
    return footprints.to_polygons(feature["geometry"], {}, str(path), footprints.Counter())


def count_demand(path: Path) -> object:
    return user_files.check_demand_size(DemandFiles({"route-files": (path,)}), 0.0, 60.0)


def write_routes(path: Path, _mb: float) -> None:
    route = '<route id="r" edges="a b" repeat="9"/>'
    path.write_text(f'<routes>{route}<flow begin="0" end="60" number="9" route="r"/></routes>', encoding="utf-8")


def polygon(holes: int) -> str:
    rings = [[[0, 0], [9, 0], [9, 9], [0, 9], [0, 0]]]
    rings += [[[x, 1], [x, 2], [x + 0.5, 2], [x, 1]] for x in range(1, 1 + holes)]
    return json.dumps({"geometry": {"type": "Polygon", "coordinates": rings}})


OSM = '<osm version="0.6"><node id="1" lat="1" lon="2" version="1"/><node id="2" lat="1" lon="2" version="1"/></osm>'


def osm_tag(mb: float) -> str:
    """The end of a map, with many ways."""
    tags = "".join(f'<tag k="{key}" v="{"x" * 200}"/>' for key in range(5))
    return "".join(f'<way id="{way}" version="1">{tags}</way>' for way in range(1, 1 + int(mb * 1000))) + "</osm>"


def write_pbf(path: Path, mb: float) -> None:
    source = path.with_suffix(".osm")
    source.write_text(OSM.replace("</osm>", osm_tag(mb)))
    pbf_of(source, path, with_bounds=False)


GRID = "ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2\n3 4\n"
BOX = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
CONFINED = {"EGVS_MAX_FILE_MB": 1, "EGVS_MAX_READER_MB": 20}


def read_points(path: Path) -> object:
    return point_clouds.read_points(path, path.name)


def write_workbook(path: Path, mb: float) -> None:
    numbers = np.random.default_rng(1).random((10 + int(mb * 60_000), 2)).tolist()
    write_xlsx(path, {"a": [("a", "b"), *numbers]})


def read_table(path: Path) -> object:
    return spreadsheets.read_rows(path, lambda names: names)


def read_layer(path: Path) -> object:
    return vector_files.read_gis_file(path, "Point")


TRIALS = {
    "scenario.toml": Trial("scenario.toml", text("seed = 1\n"), reading.read_toml, {"EGVS_MAX_DOCUMENT_MB": 1}),
    "JSON, GeoJSON": Trial("a.geojson", text('{"a": 1}'), reading.read_json, {"EGVS_MAX_DOCUMENT_MB": 1}),
    "polygons of any format": Trial(
        "a.geojson", text(polygon(3)), read_polygon, {"EGVS_MAX_CORNERS": 3}
    ),
    "tables in CSV": Trial(
        "a.csv", text("a,b\n1,2\n"), read_table, {"EGVS_MAX_DOCUMENT_MB": 1},
    ),
    "workbooks (xlsx, xls, ods)": Trial(
        "a.xlsx", write_workbook, read_table,
        {"EGVS_MAX_DOCUMENT_MB": 1, "EGVS_MAX_READER_MB": 20},
    ),
    "XML of any kind": Trial(
        "a.xml", lambda path, mb: path.write_text(f"<net><a/><b/><c>{' ' * int(mb * 1e6)}</c></net>"),  # type: ignore[arg-type,return-value]
        lambda path: list(xml.iter_elements(path, "net")), {"EGVS_MAX_ELEMENT_MB": 1, "EGVS_MAX_XML_ELEMENTS": 2},
    ),
    "gzip of any file": Trial(
        "a.xml.gz", lambda path, mb: path.write_bytes(gzip.compress(b"<net>" + b"<a/> " * int(mb * 2e5) + b"</net>")),  # type: ignore[arg-type,return-value]
        lambda path: list(xml.iter_elements(path, "net")), {"EGVS_MAX_UNPACKED_MB": 1},
    ),
    "FCD in Parquet": Trial(
        "a.parquet", write_fcd, lambda path: list(fcd.read_fcd(path)), {"EGVS_MAX_UNPACKED_MB": 1}
    ),
    "tracks in CSV": Trial(
        "a.csv", lambda path, mb: path.write_text("id,x\n1,2\n2,3\n3,4" + "0" * int(mb * 1e6)),  # type: ignore[arg-type,return-value]
        read_track_table, {"EGVS_MAX_ROWS": 2, "EGVS_MAX_ELEMENT_MB": 1},
    ),
    "tracks in Parquet, Feather": Trial(
        "a.feather", write_feather, read_feather,
        {"EGVS_MAX_FILE_MB": 1, "EGVS_MAX_ROWS": 1, "EGVS_MAX_UNPACKED_MB": 1},
    ),
    "OpenStreetMap (XML)": Trial(
        "a.osm", lambda path, mb: path.write_text(OSM.replace("</osm>", osm_tag(mb))),  # type: ignore[arg-type,return-value]
        osm.read_osm, {"EGVS_MAX_MAP_OBJECTS": 1, "EGVS_MAX_UNPACKED_MB": 1},
    ),
    "OpenStreetMap (PBF)": Trial(
        "a.osm.pbf", write_pbf,
        osm.read_osm, {"EGVS_MAX_MAP_OBJECTS": 1, "EGVS_MAX_UNPACKED_MB": 1, "EGVS_MAX_READER_MB": 20},
    ),
    "points in CSV, PLY, PCD": Trial(
        "a.csv", text("x_m,y_m,z_m\n1,2,3\n2,3,4\n"), read_points, {"EGVS_MAX_FILE_MB": 1, "EGVS_MAX_POINTS": 1}
    ),
    "LAS": Trial(
        "a.las", padded(lambda path: las(path.parent, path.name)), read_points,
        {"EGVS_MAX_FILE_MB": 1, "EGVS_MAX_POINTS": 299},
    ),
    "LAZ": Trial(
        "a.laz", padded(lambda path: las(path.parent, path.name)), read_points, CONFINED | {"EGVS_MAX_POINTS": 299}
    ),
    "E57": Trial(
        "a.e57", padded(write_scans),
        read_points, CONFINED | {"EGVS_MAX_POINTS": 1},
    ),
    "meshes": Trial(
        "a.obj", text(BOX), lambda path: meshes.load_mesh(path, path.name),
        {"EGVS_MAX_FILE_MB": 1, "EGVS_MAX_TRIANGLES": 3},
    ),
    "GeoPackage, Shapefile, KML": Trial(
        "a.gpkg", padded(foreign_files.points), read_layer, CONFINED
    ),
    "GeoParquet": Trial(
        "a.parquet", lambda path, mb: geoparquet(path, 10 + int(mb * 10_000)),  # type: ignore[arg-type,return-value]
        read_layer, {"EGVS_MAX_DOCUMENT_MB": 1, "EGVS_MAX_READER_MB": 20},
    ),
    "GeoTIFF; pictures (PNG, JPEG)": Trial("a.tif", padded_geotiff, read_geotiff, CONFINED),
    "ASCII grids": Trial("a.asc", text(GRID), read_ascii_grid, {"EGVS_MAX_FILE_MB": 1, "EGVS_MAX_POINTS": 3}),
    "sweeps in .npz": Trial("a.npz", write_npz, read_npz, {"EGVS_MAX_UNPACKED_MB": 1, "EGVS_MAX_POINTS": 2999}),
    "route files": Trial("r.rou.xml", write_routes, count_demand, {"EGVS_MAX_VEHICLES": 8, "EGVS_MAX_ROUTE_EDGES": 19}),
}  # fmt: skip

ELSEWHERE = {
    "EGVS_MAX_EDGE_PAIRS": "tests/world/test_footprints.py",
    "EGVS_MAX_READER_S": "test_time_of_a_confined_reader_has_a_limit",
    "EGVS_MAX_SUMO_MB": "tests/traffic/test_sumo_limits.py",
    "EGVS_MAX_SUMO_S": "tests/traffic/test_sumo_limits.py",
    "EGVS_MAX_SUMO_IDLE_S": "tests/traffic/test_sumo_limits.py",
}
"""Limits that no small file exceeds, and what tries them."""
PADDED = {("GeoPackage, Shapefile, KML", "EGVS_MAX_DOCUMENT_MB"), ("GeoParquet", "EGVS_MAX_FILE_MB"),
          ("sweeps in .npz", "EGVS_MAX_FILE_MB")}  # fmt: skip
"""Limits of a row that its trial does not lower."""


def trials() -> Iterator[tuple[str, str]]:
    for name, variables in table_rows().items():
        if name in TRIALS:
            yield from ((name, variable) for variable in variables if variable in TRIALS[name].lowered)


def test_each_row_and_limit_is_tried() -> None:
    rows = table_rows()
    assert rows.keys() - TRIALS.keys() == {"networks, maps and demand for SUMO"}
    listed = {(name, variable) for name, variables in rows.items() for variable in variables}
    tried = {(name, variable) for name, trial in TRIALS.items() for variable in trial.lowered}
    assert tried <= listed
    assert {pair for pair in listed - tried if pair[1] not in ELSEWHERE} == PADDED


@pytest.mark.parametrize("name", TRIALS)
def test_small_file_is_read(tmp_path: Path, name: str) -> None:
    trial = TRIALS[name]
    path = tmp_path / trial.name
    trial.write(path, 0.0)
    trial.read(path)


@pytest.mark.parametrize(("name", "variable"), list(trials()))
def test_file_above_a_limit_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, variable: str
) -> None:
    trial = TRIALS[name]
    limit = next(value for value in vars(limits).values() if getattr(value, "name", "") == variable)
    path = tmp_path / trial.name
    trial.write(path, 1.2 if limit.unit == "MB" and variable != "EGVS_MAX_READER_MB" else 0.0)
    monkeypatch.setenv(variable, str(trial.lowered[variable]))
    with pytest.raises(EgvsError) as refused:
        trial.read(path)
    message = str(refused.value)
    assert f"The limit is {trial.lowered[variable]:,} {limit.unit}; set {variable} to raise it." in message
    assert trial.name in message


@pytest.mark.slow
def test_time_of_a_confined_reader_has_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.laz"
    path.write_bytes(b"x")
    monkeypatch.setenv(limits.READER_TIME.name, "1")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    with pytest.raises(
        EgvsError, match=r"a\.laz: cannot be read \(its reader worked for more than 2 s\)\. The limit is 1 s"
    ):
        list(reader_process.read_blocks("tests.formats.endless_reader", path, path.name, "cannot be read"))
