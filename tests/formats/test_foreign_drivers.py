"""Files that make GDAL open other files or addresses, or run SQL, are rejected, and do nothing.

Each attack is a file that a scenario may name. A server and a folder are watched: no connection, no new file.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from egvs.core import limits, sandbox
from egvs.core.errors import InputError
from egvs.formats import vector_files
from egvs.formats.gdal_layers import read_layer
from egvs.formats.reader_process import read_blocks
from tests.formats.foreign_files import Watched, attacks, points, vrt, watch

pytest.importorskip("geopandas", reason="geopandas is not installed (egvs[gis])")

pytestmark = pytest.mark.system

VECTOR_SUFFIXES = (".kml", ".gpkg", ".shp", ".parquet")


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[Watched]:
    with watch(tmp_path) as folder_and_server:
        yield folder_and_server


ATTACKS = tuple(attacks(Path(), ""))


@pytest.mark.parametrize("suffix", VECTOR_SUFFIXES)
@pytest.mark.parametrize("attack", ATTACKS)
def test_vector_file_of_another_kind_is_rejected(watched: Watched, tmp_path: Path, suffix: str, attack: str) -> None:
    path = tmp_path / f"poles{suffix}"
    path.write_bytes(attacks(watched.folder, watched.url)[attack])
    with pytest.raises(InputError, match=rf"poles\{suffix}: "):
        vector_files.read_gis_file(path, "Point")
    watched.check()


@pytest.mark.slow
def test_only_one_driver_is_left_if_the_signature_is_right(watched: Watched, tmp_path: Path, monkeypatch) -> None:
    """Without the check of signatures, the list of drivers alone rejects a VRT."""
    monkeypatch.setattr("egvs.formats.gdal_layers._check_signature", lambda *_: None)
    for kind, suffix in (("KML", ".kml"), ("GeoPackage", ".gpkg"), ("Shapefile", ".shp")):
        path = tmp_path / f"poles{suffix}"
        path.write_bytes(vrt(f"{watched.folder}/secret.geojson"))
        companions = (watched.folder / "secret.geojson",)  # so that the process may read what the VRT names
        with pytest.raises(InputError, match=rf"cannot be read as {kind} \("):
            read_layer(path, kind, "Point", companions)


# --- GeoPackages -----------------------------------------------------------------------------------------------------
def run_sql(path: Path, *statements: str) -> None:
    with closing(sqlite3.connect(path)) as database, database:
        for statement in statements:
            database.execute(statement)


ENDLESS = "WITH RECURSIVE c(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM c)"
VIEWS = {
    "endless": f"{ENDLESS} SELECT i AS fid, geom, site, z_m FROM c, poles",
    "endless without a row": f"{ENDLESS} SELECT i AS fid, geom, site, z_m FROM c, poles WHERE i < 0",
    "huge": "SELECT fid, geom, zeroblob(1000000000) AS site, z_m FROM poles",
    "plain": "SELECT * FROM poles",
    "external": "SELECT fid, geom, gdal_get_pixel_value('/x.tif', 1, 'pixel', 0, 0) AS z_m FROM poles",
}


@pytest.mark.slow
@pytest.mark.parametrize("query", VIEWS)
def test_view_of_a_geopackage_is_rejected(tmp_path: Path, query: str) -> None:
    path = points(tmp_path / "poles.gpkg")
    run_sql(
        path,
        "ALTER TABLE poles RENAME TO hidden",
        f"CREATE VIEW poles AS {VIEWS[query].replace('poles', 'hidden')}",
    )
    with pytest.raises(InputError, match=r"poles\.gpkg: the layer poles is not a table, but a query"):
        vector_files.read_gis_file(path, "Point")


@pytest.mark.slow
@pytest.mark.parametrize("table", ["gpkg_contents", "gpkg_geometry_columns"])
def test_endless_table_of_contents_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, table: str) -> None:
    monkeypatch.setenv(limits.READER_TIME.name, "5")
    path = points(tmp_path / "poles.gpkg")
    run_sql(
        path,
        f"ALTER TABLE {table} RENAME TO hidden",
        f"CREATE VIEW {table} AS {ENDLESS} SELECT h.* FROM c, hidden h",
    )
    with pytest.raises(InputError, match=rf"poles\.gpkg: {table} is not a table, but a query"):
        vector_files.read_gis_file(path, "Point")


@pytest.mark.slow
def test_reads_layer_in_file_with_a_view(tmp_path: Path) -> None:
    path = points(tmp_path / "poles.gpkg")
    run_sql(
        path,
        f"CREATE VIEW zones AS {VIEWS['endless without a row']}",
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, srs_id) VALUES ('zones', 'features', 'z', 4326)",
        "INSERT INTO gpkg_geometry_columns VALUES ('zones', 'geom', 'POINT', 4326, 0, 0)",
    )
    features = vector_files.read_gis_file(path, "Point")["features"]
    assert [feature["properties"]["site"] for feature in features] == ["a"]


@pytest.mark.slow
def test_geopackage_with_unsaved_changes_is_rejected(tmp_path: Path) -> None:
    """What is in the journal alone is no part of the file that the cache key counts."""
    path = points(tmp_path / "poles.gpkg")
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("CREATE TABLE more (a INTEGER)")
        database.commit()
        with pytest.raises(InputError, match=r"poles\.gpkg: has changes that are only in poles\.gpkg-wal\. Close the"):
            vector_files.read_gis_file(path, "Point")
    assert len(vector_files.read_gis_file(path, "Point")["features"]) == 1


# --- the process ----------------------------------------------------------------------------------------------------
def outcomes(path: Path, watched: Watched) -> dict[str, Any]:
    arguments = [str(watched.folder)]
    blocks = list(read_blocks("tests.formats.hostile_reader", path, path.name, "cannot be read", arguments))
    return blocks[0].values


@pytest.mark.slow
@pytest.mark.skipif(bool(sandbox.missing_protections()), reason="this system does not confine programs")
def test_reader_reads_its_file_only(watched: Watched, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    monkeypatch.setenv("OGR_SQLITE_LOAD_EXTENSIONS", "ENABLE_SQL_LOAD_EXTENSION")
    monkeypatch.setenv("GDAL_DRIVER_PATH", str(tmp_path))
    path = tmp_path / "a.gpkg"
    path.write_text("content")
    values = outcomes(path, watched)
    assert not {"OGR_SQLITE_LOAD_EXTENSIONS", "GDAL_DRIVER_PATH", "HOME"} & {*values.pop("variables")}
    allowed = {name for name, outcome in values.items() if outcome == "done"}
    assert allowed == {"read the file", "write to the temporary folder"}
    assert set(values.values()) - {"done"} == {"PermissionError", "CalledProcessError"}
    assert path.read_text() == "content"
    watched.check()


def test_what_a_system_cannot_enforce_is_named(run_egvs: Callable[..., Any], mini: Path, monkeypatch) -> None:
    code, text, _ = run_egvs("check", mini, "--verbose")
    assert code == 0
    assert ("are confined to their files" in text) == (not sandbox.missing_protections())
    monkeypatch.setattr(sandbox, "REPLACES_PROCESS", False)
    _, text, _ = run_egvs("check", mini, "--verbose")
    assert "not protected: programs may read and write other files" in " ".join(text.split())


# --- the whole program ----------------------------------------------------------------------------------------------
def test_check_of_a_hostile_scenario_writes_nothing(watched: Watched, mini: Path, run_egvs: Callable[..., Any]) -> None:
    new = watched.folder / "new.db"
    (mini / "s.kml").write_bytes(vrt(str(watched.folder / "db.gpkg"), f"VACUUM INTO '{new}'"))
    code, text, _ = run_egvs("check", mini, "--set", 'statics.footprints=["s.kml"]')
    assert code == 2 and "cannot be read as KML (its root is <OGRVRTDataSource>)" in " ".join(text.split())
    watched.check()
