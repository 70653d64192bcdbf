"""OpenStreetMap files: XML and PBF give equal results under any name; invalid files are rejected.

osmium writes the PBF files."""

from __future__ import annotations

import gzip
from pathlib import Path

import osmium
import pytest

from egvs.core.errors import InputError
from egvs.formats import osm

SMALL = Path(__file__).parents[1] / "creation" / "data" / "small.osm"
NODE = '<node id="1" lat="1" lon="2"/>'


def put(folder: Path, content: str, name: str = "a.osm") -> Path:
    path = folder / name
    path.write_text(content, encoding="utf-8")
    return path


def osm_xml(inside: str) -> str:
    return f'<?xml version="1.0" encoding="UTF-8"?><osm version="0.6">{inside}</osm>'


def pbf_of(source: Path, path: Path, with_bounds: bool = True) -> Path:
    """Convert a map to PBF with osmium alone."""
    objects = osmium.FileProcessor(source)
    header = osmium.io.Header()
    if with_bounds:
        header.add_box(objects.header.box())
    with osmium.SimpleWriter(osmium.io.File(path, "pbf"), header=header) as writer:
        for o in objects:
            writer.add(o)
    return path


# --- equal results ---


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.osm.pbf", "a.osm"])
def test_pbf_equals_xml_under_any_name(tmp_path: Path, name: str) -> None:
    path = pbf_of(SMALL, tmp_path / name)
    assert osm.is_pbf(path) and not osm.is_pbf(SMALL)
    assert osm.read_osm(path) == osm.read_osm(SMALL)


@pytest.mark.parametrize("name", ["a.osm.gz", "a.osm.xml.gz", "a.osm"])
def test_gzip_equals_xml_under_any_name(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(gzip.compress(SMALL.read_bytes()))
    assert osm.read_osm(path) == osm.read_osm(SMALL)


def test_bounds_default_to_those_of_the_nodes(tmp_path: Path) -> None:
    inside = '<node id="2" lat="51.1234567" lon="-9.7654321"/><node id="1" lat="52.5" lon="9"><tag k="a" v="b"/></node>'
    for path in (xml := put(tmp_path, osm_xml(inside)), pbf_of(xml, tmp_path / "a.osm.pbf", with_bounds=False)):
        extract = osm.read_osm(path)
        assert extract.nodes == {1: (52.5, 9.0), 2: (51.1234567, -9.7654321)}
        assert extract.node_tags == {1: {"a": "b"}}
        assert (extract.bounds, extract.declared) == (osm.Bounds(51.1234567, -9.7654321, 52.5, 9.0), False)


def test_ways_and_relations_are_sorted_and_complete(tmp_path: Path) -> None:
    inside = (
        f'{NODE}<way id="9"><nd ref="1"/><nd ref="5"/></way><way id="-3"><nd ref="1"/><tag k="a" v="&lt;ü&gt;"/></way>'
        '<relation id="8"/><relation id="7"><member type="way" ref="9" role="outer"/>'
        '<member type="node" ref="1" role=""/><member type="relation" ref="8" role="x"/>'
        '<tag k="type" v="multipolygon"/></relation>'
    )
    extract = osm.read_osm(put(tmp_path, osm_xml(inside)))
    assert list(extract.ways.values()) == [osm.Way(-3, (1,), {"a": "<ü>"}), osm.Way(9, (1, 5), {})]
    members = (("way", 9, "outer"), ("node", 1, ""), ("relation", 8, "x"))
    assert extract.relations == (osm.Relation(7, members, {"type": "multipolygon"}), osm.Relation(8, (), {}))


@pytest.mark.parametrize("mark", ['action="delete"', 'visible="false"'])
def test_ignores_deleted_objects(tmp_path: Path, mark: str) -> None:
    deleted = (
        f'<node id="2" {mark} lat="5" lon="6"><tag k="a" v="b"/></node><node id="3" {mark}/>'
        f'<way id="1" {mark}><nd ref="1"/></way><way id="2"><nd ref="1"/></way>'
        f'<relation id="2" {mark}/><relation id="1"/>'
    )
    extract = osm.read_osm(put(tmp_path, osm_xml(NODE + deleted)))
    assert (list(extract.nodes), extract.node_tags, list(extract.ways)) == ([1], {}, [2])
    assert [relation.id for relation in extract.relations] == [1]


# --- invalid files ---


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            osm_xml(NODE).replace("<osm", '<!DOCTYPE osm [<!ENTITY a "b">]><osm'),
            "declares XML entities",
        ),
        (osm_xml(NODE).replace("<osm", '<!DOCTYPE osm [<!ENTITY a SYSTEM "file:///etc/passwd">]><osm'), "XML entities"),
        (osm_xml(NODE).replace("</osm>", ""), "is not well-formed XML: no element found"),
        ("<gpx/>", "expected the root element <osm>, got <gpx>"),
        (osm_xml(""), "has no nodes"),
        (osm_xml('<node id="1" lat="1" lon="2" action="delete"/>'), "has no nodes"),
        (osm_xml(NODE).replace(' version="0.6"', ""), "cannot be read as OpenStreetMap data .*version 0.6, got None"),
        (osm_xml(NODE + '<node id="1" lat="1" lon="inf"/>'), "node 1: lon: .* got 'inf'"),
        (osm_xml('<node lat="1" lon="2"/>'), "<node> id: expected a whole number, got None"),
        (osm_xml('<node id="1.5" lat="1" lon="2"/>'), "<node> id: expected a whole number, got '1.5'"),
        (osm_xml('<node id="1" lat="90.1" lon="2"/>'), "node 1: lat: expected degrees from -90 to 90, got '90.1'"),
        (
            osm_xml('<node id="1" lat="1" lon="-180.1"/>'),
            "node 1: lon: expected degrees from -180 to 180, got '-180.1'",
        ),
        (osm_xml('<node id="1" lat="1"/>'), "node 1: lon: .* got None"),
        (osm_xml('<node id="1" lat="1" lon="2 E"/>'), "node 1: lon: .* got '2 E'"),
        (osm_xml('<bounds minlat="0" minlon="0" maxlat="91" maxlon="9"/>' + NODE), "bounds: maxlat: .* got '91'"),
        (osm_xml(NODE + '<way id="4"><nd/></way>'), "way 4: ref: expected a whole number, got None"),
        (osm_xml(NODE + '<relation id="4"><member type="way" ref="x"/></relation>'), "relation 4: ref: .* got 'x'"),
        (
            osm_xml(NODE + '<relation id="4"><member type="cat" ref="1" role=""/></relation>'),
            "relation 4: type of a member: expected node, way or relation, got 'cat'",
        ),
    ],
)
def test_rejects_invalid_xml(tmp_path: Path, content: str, message: str) -> None:
    path = put(tmp_path, content)
    with pytest.raises(InputError, match=message) as caught:
        osm.read_osm(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


@pytest.mark.slow
def test_rejects_truncated_or_damaged_pbf(tmp_path: Path) -> None:
    path = pbf_of(SMALL, tmp_path / "a.osm.pbf")
    content = path.read_bytes()
    damaged = bytearray(content)
    damaged[len(content) // 2] ^= 255
    for part in [*(content[:end] for end in (20, 100, len(content) // 2, len(content) - 1)), bytes(damaged)]:
        path.write_bytes(part)
        with pytest.raises(InputError, match=r"a\.osm\.pbf: cannot be read as OpenStreetMap data \(.*\)\. Download"):
            osm.read_osm(path)


@pytest.mark.slow
def test_rejects_pbf_with_node_beyond_the_pole(tmp_path: Path) -> None:
    path = pbf_of(put(tmp_path, osm_xml('<node id="6" lat="91" lon="2"/>')), tmp_path / "a.osm.pbf", with_bounds=False)
    with pytest.raises(InputError, match=r"a\.osm\.pbf: node 6: lat: expected degrees from -90 to 90, got '91'"):
        osm.read_osm(path)


# --- values ---


@pytest.mark.parametrize(
    ("text", "metres"),
    [
        ("12", 12.0),
        (" 12.5 m ", 12.5),
        ("12m", 12.0),
        ("12,5", 12.5),
        ("40 ft", 12.192),
        ("40'", 12.192),
        ("40'6\"", 12.3444),
        ("0", 0.0),
        ("tall", None),
        ("~12", None),
        ("-3", None),
        ("12;15", None),
        ("1e3", None),
        ("inf", None),
        ("nan", None),
        ("1000", None),
        ("", None),
    ],
)
def test_parse_length(text: str, metres: float | None) -> None:
    assert osm.parse_length_m(text) == (None if metres is None else pytest.approx(metres))


@pytest.mark.parametrize(("declared", "codec"), [("Shift_JIS", "cp932"), ("EUC-JP", "euc_jp"), ("UTF-16", "utf-16")])
@pytest.mark.parametrize("packed", [False, True])
def test_reads_other_encodings(tmp_path: Path, declared: str, codec: str, packed: bool) -> None:
    tag = '<way id="3"><nd ref="1"/><nd ref="1"/><tag k="name" v="青梅街道"/></way>'
    data = osm_xml(NODE + tag).replace("UTF-8", declared).encode(codec)
    (tmp_path / "a.osm").write_bytes(gzip.compress(data, mtime=0) if packed else data)
    assert osm.read_osm(tmp_path / "a.osm").ways[3].tags == {"name": "青梅街道"}


@pytest.mark.slow
def test_rejects_more_objects_than_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_MAP_OBJECTS", "10")
    pbf = pbf_of(SMALL, tmp_path / "a.osm.pbf")
    for path in (SMALL, pbf):
        message = (
            rf"{path.name}: has more than 10 objects\. Use a smaller extract\. The limit is 10 objects; set "
            rf"EGVS_MAX_MAP_OBJECTS"
        )
        with pytest.raises(InputError, match=message):
            osm.read_osm(path)
