"""What ``egvs new`` refuses: each wrong file, place or folder with its message, and nothing written."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import pytest

from egvs.core.errors import InputError
from egvs.importers import openstreetmap
from tests.importers.test_openstreetmap import SMALL, edited

COVER = (
    '<node id="1" ',
    '<node id="901" lat="51.99" lon="9.99"/><node id="902" lat="51.99" lon="10.01"/>'
    '<node id="903" lat="52.01" lon="10.01"/><node id="904" lat="52.01" lon="9.99"/><node id="1" ',
)
BLOCK = (
    "<relation",
    '<way id="9"><nd ref="901"/><nd ref="902"/><nd ref="903"/><nd ref="904"/><nd ref="901"/>'
    '<tag k="building" v="yes"/></way><relation',
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([("</osm>", "")], "is not well-formed XML"),
        ([("^.*", "")], "is not well-formed XML"),
        ([("^.*", '{"elements": []}')], "is not well-formed XML"),
        ([("^.*", '<gpx version="1.1"></gpx>')], "expected the root <osm>, got <gpx>"),
        ([("^.*", '<osm version="0.6"></osm>')], "has no nodes"),
        ([("<osm ", '<!DOCTYPE osm [<!ENTITY a "b">]><osm ')], "entities"),
        ([('"52.0000000"', '"52 N"')], "node 1: lat: '52 N'; degrees from -90 to 90"),
        ([('"52.0000000"', '"nan"')], "node 1: lat: 'nan'"),
        ([('lon="10.0000000"', "")], "node 1: lon: None; degrees from -180 to 180"),
        ([('maxlat="', 'maxlat="9')], "bounds: maxlat"),
        ([('<way id="1001">', "<way>")], "<way> id: None; a whole number"),
        ([('<nd ref="1"/>', '<nd ref="one"/>')], "way 1001: ref: 'one'; a whole number"),
        ([('"(secondary|tertiary)"', '"footway"')], "has no drivable streets that meet"),
        ([('"highway"', '"was:highway"')], "has no drivable streets that meet"),
        ([(' <way id="1002">.*?</way>', "")], "has no drivable streets that meet"),
        ([COVER, BLOCK], "no place for a pole is free along the kerbs of the signalised junction of East Street"),
    ],
)
def test_rejects_bad_extract(tmp_path: Path, changes: list[tuple[str, str]], message: str) -> None:
    if changes[0][0] == "^.*":
        bad = tmp_path / "edited.osm"
        bad.write_text(changes[0][1], encoding="utf-8")
    else:
        bad = edited(tmp_path, *changes)
    with pytest.raises(InputError) as caught:
        openstreetmap.create_scenario(tmp_path / "out", bad)
    assert message in str(caught.value) and str(bad) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == [bad], "something was written"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (gzip.compress(b"<osm></osm>", mtime=0)[:-6], "damaged gzip"),
        (b"\x00\x00\x00\x0d\x0a\x09OSMHeader\x18\x7d", r"cannot be read as OpenStreetMap data \(PBF error"),
        (b"\x89PNG\r\n\x1a\n" + bytes(64), "is not well-formed XML"),
    ],
)
def test_rejects_bad_file(tmp_path: Path, content: bytes, message: str) -> None:
    bad = tmp_path / "bad.osm"
    bad.write_bytes(content)
    with pytest.raises(InputError, match=re.escape(str(bad)) + ".*" + message):
        openstreetmap.create_scenario(tmp_path / "out", bad)
    assert list(tmp_path.iterdir()) == [bad]


def test_rejects_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.osm: no such file"):
        openstreetmap.create_scenario(tmp_path / "out", tmp_path / "nowhere.osm")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("at", [(0.0, 0.0), (10.0, 52.0), (float("nan"), 10.0)])
def test_rejects_position_outside_extract(tmp_path: Path, at: tuple[float, float]) -> None:
    with pytest.raises(InputError, match=r"--at: .* is outside the extract.*latitude 51\.998"):
        openstreetmap.create_scenario(tmp_path / "out", SMALL, at=at)
    assert not list(tmp_path.iterdir())


def test_rejects_folder_with_content(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep me", encoding="utf-8")
    with pytest.raises(InputError, match="not empty"):
        openstreetmap.create_scenario(tmp_path, SMALL)
    with pytest.raises(InputError, match=r"mine\.txt: .*existing file"):
        openstreetmap.create_scenario(tmp_path / "mine.txt", SMALL)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]
