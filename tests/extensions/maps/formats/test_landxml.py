"""LandXML surfaces: order of coordinates, hidden faces, units, damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.extensions.maps.formats.landxml import read_landxml

HEAD = (
    '<?xml version="1.0" encoding="UTF-8"?>\n<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2">'
)


def landxml(faces: str, head: str = "", points: str = "") -> str:
    """Four points of a square of 10 m east of (1000, 2000), of which the north-eastern is 4 m higher."""
    points = points or (
        '<P id="7">2000 1000 50</P><P id="8">2000 1010 50</P><P id="9">2010 1010 54</P><P id="3">2010 1000 50</P>'
    )
    return (
        f'{HEAD}{head}<Surfaces><Surface name="ground"><Definition surfType="TIN"><Pnts>{points}</Pnts>'
        f"<Faces>{faces}</Faces></Definition></Surface></Surfaces></LandXML>\n"
    )


FACES = '<F>7 8 9</F><F n="1 2 3">7 9 3</F><F i="1">7 8 3</F>'


def read(folder: Path, text: str):  # type: ignore[no-untyped-def]
    (folder / "s.xml").write_text(text)
    return read_landxml(folder / "s.xml")


def test_northing_comes_before_easting(tmp_path: Path) -> None:
    file = read(tmp_path, landxml(FACES, '<CoordinateSystem epsgCode="25832"/>'))
    (surface,) = file.surfaces
    assert surface.name == "ground" and file.crs == "EPSG:25832" and file.hidden_faces == 1
    assert surface.vertices.tolist() == [[1000, 2000, 50], [1010, 2000, 50], [1010, 2010, 54], [1000, 2010, 50]]
    assert surface.faces.tolist() == [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize(("units", "factor"), [
    ('<Metric linearUnit="meter"/>', 1.0), ('<Metric linearUnit="millimeter"/>', 0.001),
    ('<Imperial linearUnit="foot"/>', 0.3048), ('<Imperial linearUnit="USSurveyFoot"/>', 1200 / 3937),
])  # fmt: skip
def test_heights_are_metres(units: str, factor: float, tmp_path: Path) -> None:
    (surface,) = read(tmp_path, landxml(FACES, f"<Units>{units}</Units>")).surfaces
    assert surface.vertices[:, 2] == pytest.approx(np.array([50, 50, 54, 50]) * factor)
    assert surface.vertices[0, 0] == 1000  # x and y are in the units of the reference system


def test_quadrilateral_is_two_triangles(tmp_path: Path) -> None:
    assert read(tmp_path, landxml("<F>7 8 9 3</F>")).surfaces[0].faces.tolist() == [[0, 1, 2], [0, 2, 3]]


BROKEN = {
    "empty": ("", "not well-formed"),
    "other root": ("<osm/>", "expected the root element <LandXML>, got <osm>"),
    "truncated": (landxml(FACES)[:-20], "not well-formed"),
    "entity": (f'<!DOCTYPE a [<!ENTITY x "y">]>{landxml(FACES)[39:]}', "entities or a document type"),
    "external": (f'<!DOCTYPE a SYSTEM "file:///etc/passwd">{landxml(FACES)[39:]}', "entities or a document type"),
    "no faces": (landxml(""), "has no triangulated surface"),
    "only hidden": (landxml('<F i="1">7 8 9</F>'), "has no triangulated surface"),
    "two numbers": (landxml(FACES).replace("2000 1010 50", "2000 1010"), "point 8: expected northing, easting"),
    "nan": (landxml(FACES).replace("2000 1010 50", "2000 1010 nan"), "point 8: expected northing"),
    "unknown": (landxml("<F>7 8 10</F>"), "names the point '10', which is not there"),
    "one corner": (landxml("<F>7</F>"), "expected the ids of 3 points, got 1"),
    "twice": (landxml(FACES).replace('id="8"', 'id="7"'), "point 7: the id occurs twice"),
    "unit": (landxml(FACES, '<Metric linearUnit="parsec"/>'), "linearUnit: expected one of meter"),
    "deep": (HEAD + "<a>" * 200, "nested more than 100 deep"),
    "endless": (landxml(FACES, points="<P id='1'>" + "1" * 20_000 + "</P>"), "unlimited text"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_rejects_broken_files(case: str, tmp_path: Path) -> None:
    text, message = BROKEN[case]
    with pytest.raises(InputError) as error:
        read(tmp_path, text)
    assert message in str(error.value) and "s.xml" in str(error.value)


@pytest.mark.parametrize(("encoding", "blanks"), [("utf-16", 1), ("utf-8", 600)])
def test_unknown_encoding_is_an_error(tmp_path: Path, encoding: str, blanks: int) -> None:
    """The declaration is not where it is looked for: in UTF-16, or after many blanks."""
    declared = f"<?xml{' ' * blanks}version='1.0' encoding='none-such'?><LandXML/>"
    (tmp_path / "s.xml").write_bytes(declared.encode(encoding))
    with pytest.raises(InputError, match=r"s\.xml: cannot be read \(unknown encoding: none-such\)"):
        read_landxml(tmp_path / "s.xml")


def test_points_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_POINTS", "3")
    with pytest.raises(InputError, match="EGVS_MAX_POINTS"):
        read(tmp_path, landxml(FACES))
