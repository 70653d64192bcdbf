"""OpenDRIVE maps: geometry against closed forms and Fresnel integrals, lanes by hand, damaged files.

Source of the closed forms: a clothoid is the Fresnel integral (Abramowitz and Stegun, 7.3).
"""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.special import fresnel

from egvs.core.errors import InputError
from egvs.extensions.maps.formats.opendrive import MAX_ROAD_M, PlanElement, read_opendrive
from tests.extensions.maps import opendrive_maps as maps
from tests.extensions.maps.opendrive_maps import geometry, lane, opendrive, road, section

TOWN01 = Path(__file__).parents[5] / "shared" / "real" / "opendrive" / "town01.xodr.gz"


def write(folder: Path, text: str) -> Path:
    path = folder / "map.xodr"
    path.write_text(text)
    return path


def test_line_and_arc_have_their_closed_forms() -> None:
    s = np.linspace(0, 30, 7)
    line = PlanElement(0, 30, 5, 6, 0.3, "line").at(s)
    assert line == pytest.approx(
        np.column_stack([5 + s * math.cos(0.3), 6 + s * math.sin(0.3), np.full(7, 0.3)]), abs=1e-12
    )
    arc = PlanElement(0, 30, 0, 0, 0.0, "arc", curvatures=(0.1, 0.1)).at(s)  # a circle of 10 m around (0, 10)
    assert arc == pytest.approx(np.column_stack([10 * np.sin(s / 10), 10 - 10 * np.cos(s / 10), s / 10]), abs=1e-9)


def test_spiral_is_a_fresnel_integral() -> None:
    length, last = 40.0, 0.05
    s = np.linspace(0, length, 9)
    scale = math.sqrt(math.pi * length / last)  # heading = last s^2 / 2 length = pi / 2 (s / scale)^2
    sine, cosine = fresnel(s / scale)
    expected = np.column_stack([scale * cosine, scale * sine, last * s**2 / (2 * length)])
    assert PlanElement(0, length, 0, 0, 0.0, "spiral", curvatures=(0.0, last)).at(s) == pytest.approx(
        expected, abs=1e-8
    )


def test_cubics_begin_in_the_frame_of_their_start() -> None:
    element = PlanElement(0, 10, 1, 2, math.pi / 2, "paramPoly3", u=(0, 10, 0, 0), v=(0, 0, 4, 0), p_max=1.0)
    # u along y, v along -x: at p = 1/2, u = 5 and v = 1, and the slope dv/du is 4 / 10
    assert element.at(np.array([5.0]))[0] == pytest.approx([0.0, 7.0, math.pi / 2 + math.atan2(4, 10)], abs=1e-12)
    by_length = PlanElement(0, 10, 0, 0, 0.0, "paramPoly3", u=(0, 1, 0, 0), v=(0, 0, 0, 0), p_max=10.0)
    assert by_length.at(np.array([4.0]))[0] == pytest.approx([4, 0, 0], abs=1e-12)


def test_poly3_advances_along_the_curve() -> None:
    """A straight line v = u: after a length of 5 root 2, the point is (5, 5)."""
    element = PlanElement(0, 10 * math.sqrt(2), 0, 0, 0.0, "poly3", v=(0, 1, 0, 0))
    assert element.at(np.array([5 * math.sqrt(2)]))[0] == pytest.approx([5, 5, math.pi / 4], abs=1e-3)


def test_lane_in_an_arc_is_as_long_as_by_hand(tmp_path: Path) -> None:
    """A quarter of a left-hand bend of 50 m: the lane to the right, 3.5 m wide, has a radius of 51.75 m."""
    quarter = 50 * math.pi / 2
    plan = geometry(0, 0, 0, quarter, '<arc curvature="0.02"/>')
    text = opendrive(road("7", quarter, plan, section([lane(-1)], [lane(1, width="3 0 0 0")])))
    found = read_opendrive(write(tmp_path, text)).roads["7"]
    line = found.lane_line(found.sections[0], -1, step_m=0.1)
    assert np.hypot(*np.diff(line[:, :2], axis=0).T).sum() == pytest.approx(51.75 * math.pi / 2, abs=1e-3)
    left = found.lane_line(found.sections[0], 1)
    assert np.hypot(*(left[:, :2] - [0, 50]).T) == pytest.approx(np.full(len(left), 48.5), abs=1e-9)
    mirrored = found.lane_line(found.sections[0], -1, mirrored=True)
    assert np.hypot(*(mirrored[:, :2] - [0, 50]).T) == pytest.approx(np.full(len(mirrored), 48.25), abs=1e-9)


def test_lane_offset_width_and_height_change_along_the_road(tmp_path: Path) -> None:
    text = maps.hill().replace("<lanes>", '<lanes><laneOffset s="0" a="1" b="0.01" c="0" d="0"/>', 1)
    found = read_opendrive(write(tmp_path, text)).roads["1"]
    line = found.lane_line(found.sections[0], -1, step_m=50)
    assert line == pytest.approx(np.array([[0, -0.75, 2], [50, -0.25, 4], [100, 0.25, 6]]), abs=1e-12)
    assert any(any(cubic[1:]) for cubic in found.superelevations)


def test_reads_links_signals_and_header(tmp_path: Path) -> None:
    signals = (
        '<signal id="a" s="95" t="-8" dynamic="yes" orientation="+" type="1000001"/>'
        '<signal id="b" s="50" t="-8" dynamic="no" orientation="+" type="274"/>'
    )
    text = maps.merge(signals).replace("</geoReference>", '</geoReference><offset x="1" y="2" z="3" hdg="0.5"/>')
    found = read_opendrive(write(tmp_path, text))
    assert (found.reference, found.offset_m, found.offset_rad) == (maps.UTM, (1.0, 2.0, 3.0), 0.5)
    assert [(signal.id, signal.dynamic) for signal in found.roads["1"].signals] == [("a", True), ("b", False)]
    assert found.roads["1"].successor == ("junction", "9", "start")
    assert found.roads["5"].junction == "9" and found.roads["1"].junction == ""
    assert [(c.incoming, c.connecting, c.links) for c in found.junctions["9"]] == [
        ("1", "5", ((-1, -1),)), ("1", "6", ((-2, -1),)),
    ]  # fmt: skip


def test_reads_gzip_and_namespaces(tmp_path: Path) -> None:
    text = opendrive(*maps.two_roads()).replace("<OpenDRIVE>", '<OpenDRIVE xmlns="http://example.org/odr">')
    (tmp_path / "map.xodr.gz").write_bytes(gzip.compress(text.encode()))
    assert set(read_opendrive(tmp_path / "map.xodr.gz").roads) == {"1", "2"}


BROKEN = {
    "empty": ("", "not well-formed"),
    "other root": ("<osm/>", "expected the root element <OpenDRIVE>, got <osm>"),
    "no roads": ("<OpenDRIVE/>", "the map has no roads"),
    "truncated": (maps.merge()[:900], "not well-formed"),
    "entity": ('<!DOCTYPE a [<!ENTITY x "y">]><OpenDRIVE/>', "entities or a document type"),
    "no number": (maps.merge().replace('length="100"', 'length="long"', 1), "expected a number, got 'long'"),
    "NaN": (maps.merge().replace('hdg="0"', 'hdg="nan"', 1), "hdg: expected a number, got 'nan'"),
    "huge": (maps.merge().replace('length="100"', 'length="1e9"', 1), f"expected a length from 0 to {MAX_ROAD_M:g} m"),
    "no shape": (maps.merge().replace("<line/>", "", 1), "<geometry>: expected one of line, arc"),
    "twice": (opendrive(*maps.two_roads()[:1] * 2), "the id occurs twice"),
    "lane": (maps.merge().replace('<lane id="-2"', '<lane id="two"', 1), "id: expected a whole number, got 'two'"),
    "centre": (maps.merge().replace('<lane id="0"', '<lane id="zero"', 1), "id: expected a whole number, got 'zero'"),
    "centre 1": (maps.merge().replace('<lane id="0"', '<lane id="1"', 1), "<center>: expected a lane with the id 0"),
    "lane 0": (maps.merge().replace('<lane id="-2"', '<lane id="0"', 1), "expected an id other than 0"),
    "missing": (maps.merge().replace('id="1" junction', "junction", 1), "the attribute 'id' is missing"),
    "offset": (maps.merge().replace("</geoReference>", '</geoReference><offset x="a"/>'), "<header>"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_rejects_broken_maps(case: str, tmp_path: Path) -> None:
    text, message = BROKEN[case]
    with pytest.raises(InputError) as error:
        read_opendrive(write(tmp_path, text))
    assert message in str(error.value) and "map.xodr" in str(error.value)


def test_real_map_has_the_roads_that_it_says(tmp_path: Path) -> None:
    """Road 1 of CARLA's Town01 begins with a line of 35.05 m; all roads are flat, no signal."""
    if not TOWN01.is_file():
        pytest.skip(f"{TOWN01.name} is not beside the checkout (shared/real)")
    found = read_opendrive(TOWN01)
    assert (len(found.roads), len(found.junctions)) == (98, 12)
    first = found.roads["1"].plan[0]
    assert (first.shape, round(first.length_m, 2)) == ("line", 35.05)
    ends = [road.reference_line(np.array([road.length_m]))[0, :2] for road in found.roads.values()]
    joined = 0
    for one, end in zip(found.roads.values(), ends, strict=True):
        link = one.successor
        if link is not None and link.kind == "road":
            other = found.roads[link.id]
            at = 0.0 if link.contact == "start" else other.length_m
            assert np.hypot(*(other.reference_line(np.array([at]))[0, :2] - end)) < 0.05
            joined += 1
    assert joined > 70
