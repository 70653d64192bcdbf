"""Small files that ask for much memory or time are rejected by a limit, or read in a moment.

The files are made here; limits are set low, so that each file is small.
"""

from __future__ import annotations

import gzip
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import egvs
from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.reading import read_json
from egvs.formats import pcd, reader_process, vector_files, xml
from egvs.sensors import sites

pytestmark = pytest.mark.system


@pytest.mark.slow
def test_rejects_late_duplicate_of_many_keys(tmp_path: Path) -> None:
    """One look at each key: with a count of all names for each name, this takes an hour."""
    path = tmp_path / "a.json"
    keys = [f'"{number}": 0' for number in range(400_000)]
    path.write_text("{" + ", ".join([*keys, keys[-1]]) + "}")
    with pytest.raises(InputError, match=r"a\.json: is not valid JSON: the key '399999' occurs twice"):
        read_json(path)


def test_sites_have_a_limit_of_columns(mini: Path) -> None:
    names = [f"column_{number}" for number in range(600)]
    header = ",".join(["site", "x_m", "y_m", "z_m", *names])
    row = ",".join(["a", "1", "2", "3", *["0"] * len(names)])
    (mini / "sites.csv").write_text(f"{header}\n{row}\n")
    with pytest.raises(InputError, match=r"sites\.csv: expected at most 500 columns, got 604"):
        sites.candidate_sites(egvs.load(mini))


def test_unpacked_points_beyond_the_declared_ones_are_not_made(tmp_path: Path) -> None:
    """A run of LZF that repeats one byte: each three bytes make 264."""
    repeated = b"\x00A" + b"\xe0\xff\x00" * 400_000
    header = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA binary_compressed\n"
    path = tmp_path / "a.pcd"
    path.write_bytes(header.encode() + struct.pack("<II", len(repeated), 36) + repeated)
    with pytest.raises(InputError, match=r"a\.pcd"):
        pcd.read(path, "a.pcd")
    assert pcd._decompress_lzf(repeated, 36) is None


def geoparquet(path: Path, rows: int) -> Path:
    """Polygons that all are the same, encoded as a dictionary of one value."""
    ring = np.array([40, 3, 43, 3, 43, 6, 40, 3], "<f8").tobytes()
    polygon = struct.pack("<BIII", 1, 3, 1, 4) + ring
    column = {"encoding": "WKB", "geometry_types": ["Polygon"]}
    geo = {"version": "1.0.0", "primary_column": "geometry", "columns": {"geometry": column}}
    values = pa.DictionaryArray.from_arrays(np.zeros(rows, np.int32), pa.array([polygon], pa.binary()))
    table = pa.table({"geometry": values}).replace_schema_metadata({"geo": json.dumps(geo)})
    pq.write_table(table, path, compression="zstd")
    return path


@pytest.mark.slow
def test_geoparquet_has_the_limit_of_geojson(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A polygon takes 93 bytes, and a feature 100 more."""
    path = geoparquet(tmp_path / "a.parquet", 200_000)
    assert path.stat().st_size < 10_000
    monkeypatch.setenv(limits.DOCUMENT.name, "30")
    with pytest.raises(InputError, match=r"a\.parquet: has more than 30 MB as GeoJSON\. The limit is 30 MB; set EGVS"):
        vector_files.read_gis_file(path, "Polygon")
    monkeypatch.setenv(limits.DOCUMENT.name, "50")
    assert len(vector_files.read_gis_file(path, "Polygon")["features"]) == 200_000


@pytest.mark.slow
def test_geoparquet_is_read_by_one_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = geoparquet(tmp_path / "a.parquet", 10)
    started = []
    start = reader_process.start_program

    def count(*arguments: Any) -> Any:
        started.append(arguments)
        return start(*arguments)

    monkeypatch.setattr(reader_process, "start_program", count)
    assert len(vector_files.read_gis_file(path, "Polygon")["features"]) == 10
    assert len(started) == 1


@pytest.mark.slow
def test_xml_has_a_limit_of_elements(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.xml.gz"
    path.write_bytes(gzip.compress(b"<r>" + b"<a/>" * 100_001 + b"</r>"))
    assert sum(1 for _ in xml.iter_elements(path, "r")) == 100_001
    monkeypatch.setenv(limits.XML_ELEMENTS.name, "100000")
    with pytest.raises(InputError, match=r"a\.xml\.gz: has more than 100,000 elements\. The limit is 100,000 elem"):
        list(xml.iter_elements(path, "r"))
