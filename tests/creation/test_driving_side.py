"""The side of traffic: of countries, of what maps tell, and of the options."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from egvs.core.errors import InputError
from egvs.creation import driving_side, sumo_network
from egvs.creation.driving_side import Evidence, choose_side, side_at
from egvs.creation.map_parts import RoadOptions
from egvs.creation.openstreetmap.side_evidence import choose_map_side, exceptions_note, side_evidence
from egvs.formats import osm
from egvs.formats.osm import Bounds, OsmExtract, Relation, Way
from tests.creation.new_scenarios import create_scenario

LEFT = {
    "Dover": (51.13, 1.31), "London": (51.5, -0.12), "Edinburgh": (55.95, -3.19), "Belfast": (54.6, -5.93),
    "Dublin": (53.35, -6.26), "Douglas": (54.15, -4.48), "Saint Helier": (49.18, -2.11), "Valletta": (35.898, 14.51),
    "Nicosia, south": (35.165, 33.36), "Nicosia, north": (35.19, 33.36), "Hong Kong": (22.32, 114.17),
    "Macau": (22.19, 113.545), "Tokyo": (35.68, 139.76), "Naha": (26.21, 127.68), "Bangkok": (13.75, 100.5),
    "Nong Khai": (17.87, 102.74), "Singapore": (1.29, 103.85), "Jakarta": (-6.2, 106.82), "Dili": (-8.556, 125.57),
    "Delhi": (28.61, 77.2), "Kathmandu": (27.7, 85.32), "Lahore": (31.55, 74.34), "Male": (4.175, 73.51),
    "Sydney": (-33.87, 151.2), "Auckland": (-36.85, 174.76), "Port Moresby": (-9.44, 147.18), "Suva": (-18.14, 178.44),
    "Apia": (-13.83, -171.76), "Tarawa": (1.33, 172.98), "Nairobi": (-1.29, 36.82), "Kampala": (0.31, 32.58),
    "Cape Town": (-33.92, 18.42), "Windhoek": (-22.56, 17.08), "Maputo": (-25.97, 32.57), "Georgetown": (6.8, -58.16),
    "Paramaribo": (5.85, -55.2), "Kingston": (18.0, -76.79), "Nassau": (25.05, -77.35), "Hamilton": (32.29, -64.78),
    "Charlotte Amalie": (18.342, -64.93), "Road Town": (18.427, -64.62), "Stanley": (-51.69, -57.86),
}  # fmt: skip
RIGHT = {
    "Calais": (50.95, 1.86), "Paris": (48.85, 2.35), "Berlin": (52.5, 13.4), "Gibraltar": (36.14, -5.353),
    "Shenzhen": (22.543, 114.058), "Zhuhai": (22.27, 113.57), "Seoul": (37.56, 126.97), "Taipei": (25.03, 121.56),
    "Vientiane": (17.96, 102.61), "Yangon": (16.8, 96.15), "Manila": (14.6, 120.98), "Lhasa": (29.65, 91.1),
    "Kabul": (34.53, 69.17), "Noumea": (-22.27, 166.44), "Pago Pago": (-14.278, -170.7), "Port Vila": (-17.73, 168.32),
    "Addis Ababa": (9.03, 38.74), "Kigali": (-1.95, 30.06), "Luanda": (-8.84, 13.23), "Cayenne": (4.92, -52.31),
    "Boa Vista": (2.82, -60.67), "San Juan": (18.466, -66.105), "Miami": (25.76, -80.19), "Willemstad": (12.11, -68.93),
    "New York": (40.7, -74.0), "Diego Garcia": (-7.31, 72.41),
}  # fmt: skip


def side_of(at: tuple[float, float]) -> str:
    """The side at a position."""
    evidence = side_at(*at)
    assert evidence is not None
    return evidence.side


def test_side_of_cities_and_borders() -> None:
    assert {name: side_of(at) for name, at in LEFT.items()} == dict.fromkeys(LEFT, "left")
    assert {name: side_of(at) for name, at in RIGHT.items()} == dict.fromkeys(RIGHT, "right")


def test_positions_near_a_border_are_weak_evidence() -> None:
    weak = {name for name, at in (LEFT | RIGHT).items() if not (side_at(*at) or Evidence("left", "")).is_strong}
    assert weak == {"Shenzhen", "Macau", "Vientiane", "Nong Khai"}
    assert side_at(0.0001, 0.0003) is None  # an anonymised map
    evidence = side_at(*RIGHT["Vientiane"])
    assert evidence is not None and evidence.reason.endswith("but 0.6 km from a border where the side changes")


def test_shipped_outlines_have_their_licence() -> None:
    assert "ISC" in driving_side.COUNTRIES_FILE.with_name("left_hand_traffic.LICENCE.md").read_text(encoding="utf-8")
    names, outlines, _ = driving_side._countries()
    assert len(names) == 106 and sum(outline.area for outline in outlines) > 100


RING, RING_RIGHT = Evidence("left", "the ring runs clockwise"), Evidence("right", "another ring runs counter-clockwise")
ENGLAND, BERLIN = side_at(51.5, -0.12), side_at(52.5, 13.4)


@pytest.mark.parametrize(
    ("option", "of_map", "of_position", "lefthand", "note"),
    [
        (None, [RING], ENGLAND, True, "left: the ring runs clockwise, and the map lies in England."),
        (None, [], ENGLAND, True, "left: the map lies in England."),
        (None, [], BERLIN, False, "right: the map lies outside the countries with left-hand traffic."),
        (None, [], None, False, "right: neither the map nor its position tells the side."),
        (
            None,
            [RING],
            side_at(*RIGHT["Shenzhen"]),
            True,
            "left: the ring runs clockwise, although the map lies outside",
        ),
        (True, [], BERLIN, True, "left, as requested, although the map lies outside"),
        (
            False,
            [RING, RING_RIGHT],
            ENGLAND,
            False,
            "right, as requested, although the ring runs clockwise, and the map",
        ),
        (True, [RING_RIGHT], ENGLAND, True, "left, as requested, although another ring runs counter-clockwise."),
        (True, [RING], ENGLAND, True, "left, as requested."),
    ],
)
def test_evidence_decides(
    option: bool | None, of_map: list[Evidence], of_position: Evidence | None, lefthand: bool, note: str
) -> None:
    side = choose_side(option, of_map, of_position, "map.osm")
    assert side.lefthand == lefthand
    assert side.note.startswith(f"Traffic drives on the {note}")


@pytest.mark.parametrize(
    ("option", "of_map", "of_position", "message"),
    [
        (
            None,
            [RING],
            BERLIN,
            r"unclear: the left, as the ring .*; the right, as the map .* Add --lefthand or --right",
        ),
        (None, [RING, RING_RIGHT], None, r"unclear: .* Add --lefthand or --righthand"),
        (False, [RING], ENGLAND, r"is for left-hand traffic: the ring runs clockwise, .* Leave out --righthand"),
        (True, [RING_RIGHT], None, r"is for right-hand traffic: .* Leave out --lefthand"),
    ],
)
def test_contradictions_stop(
    option: bool | None, of_map: list[Evidence], of_position: Evidence | None, message: str
) -> None:
    with pytest.raises(InputError, match=rf"map\.osm: .*{message}"):
        choose_side(option, of_map, of_position, "map.osm")


def ring_map(path: Path, lat_deg: float, lon_deg: float, *, clockwise: bool) -> Path:
    """A roundabout of four arms, drawn in driving direction."""
    m_deg = 1 / 111_320
    shrink = math.cos(math.radians(lat_deg))

    def node(number: int, radius_m: float, angle: float) -> str:
        lat, lon = lat_deg + radius_m * math.sin(angle) * m_deg, lon_deg + radius_m * math.cos(angle) * m_deg / shrink
        return f'<node id="{number}" lat="{lat:.7f}" lon="{lon:.7f}"/>'

    turn = -1 if clockwise else 1
    nodes = [node(1 + k, 18.0, turn * 2 * math.pi * k / 12) for k in range(12)]
    nodes += [node(50 + k, 220.0, turn * math.pi / 2 * k) for k in range(4)]
    refs = "".join(f'<nd ref="{1 + k % 12}"/>' for k in range(13))
    tags = '<tag k="highway" v="secondary"/>'
    ways = [f'<way id="1">{refs}{tags}<tag k="junction" v="roundabout"/></way>']
    ways += [f'<way id="{2 + k}"><nd ref="{50 + k}"/><nd ref="{1 + 3 * k}"/>{tags}</way>' for k in range(4)]
    path.write_text(f'<osm version="0.6">{"".join([*nodes, *ways])}</osm>', encoding="utf-8")
    return path


def is_lefthand(folder: Path) -> bool:
    """Whether a new scenario or city has left-hand traffic."""
    return 'lefthand="true"' in (folder / "network.net.xml").read_text(encoding="utf-8")


@pytest.mark.slow
def test_map_of_england_gets_left_hand_traffic(tmp_path: Path) -> None:
    path = ring_map(tmp_path / "england.osm", 52.5, -1.5, clockwise=True)
    made = create_scenario(tmp_path / "made", path)
    assert is_lefthand(tmp_path / "made")
    assert made.notes[0] == (
        "Traffic drives on the left: the one-way ring (way 1) runs clockwise, and the map lies in England."
    )
    with pytest.raises(InputError, match=r"england\.osm: is for left-hand traffic"):
        create_scenario(tmp_path / "other", path, righthand=True)
    with pytest.raises(InputError, match=r"--lefthand: cannot be combined with --righthand"):
        create_scenario(tmp_path / "other", path, lefthand=True, righthand=True)


@pytest.mark.slow
def test_ring_that_contradicts_the_country_stops_until_the_side_is_stated(tmp_path: Path) -> None:
    path = ring_map(tmp_path / "map.osm", 52.0, 10.0, clockwise=True)
    with pytest.raises(InputError, match=r"map\.osm: the side of traffic is unclear: .* Add --lefthand or --righthand"):
        create_scenario(tmp_path / "made", path)
    made = create_scenario(tmp_path / "made", path, righthand=True)
    assert not is_lefthand(tmp_path / "made")
    assert made.notes[0].startswith("Traffic drives on the right, as requested, although the one-way ring (way 1) runs")


def extract(ways: list[Way], relations: tuple[Relation, ...] = (), **node_tags: dict[str, str]) -> OsmExtract:
    """Ways over the corners of a square, 1 to 4, counter-clockwise."""
    corners = {1: (52.0, 10.0), 2: (52.0, 10.001), 3: (52.001, 10.001), 4: (52.001, 10.0)}
    tags = {int(name.removeprefix("n")): tag for name, tag in node_tags.items()}
    return OsmExtract(corners, tags, {way.id: way for way in ways}, relations, Bounds(52, 10, 52.001, 10.001), True)


def way(number: int, *nodes: int, **tags: str) -> Way:
    """A street."""
    return Way(number, nodes, {"highway": "primary", **tags})


@pytest.mark.parametrize(
    ("made", "expected"),
    [
        (extract([way(1, 1, 2, 3, 4, 1, junction="roundabout")]), "right"),
        (extract([way(1, 1, 4, 3, 2, 1, junction="circular")]), "left"),
        (extract([way(1, 1, 2, 3, 4, 1, junction="roundabout", oneway="-1")]), "left"),
        (extract([way(1, 1, 2, 3, junction="roundabout"), way(2, 3, 4, 1, junction="roundabout")]), "right"),
        (extract([way(1, 1, 2, 3, junction="roundabout")]), None),
        (extract([way(1, 1, 2)], n2={"highway": "mini_roundabout", "direction": "clockwise"}), "left"),
        (extract([way(1, 1, 2)], (Relation(9, (), {"type": "boundary", "driving_side": "left"}),)), "left"),
        (extract([way(1, 1, 2, driving_side="left"), way(2, 2, 3), way(3, 3, 4)]), None),
        (extract([way(1, 1, 2, driving_side="left"), way(2, 2, 3, driving_side="left"), way(3, 3, 4)]), "left"),
    ],
)
def test_map_tells_the_side(made: OsmExtract, expected: str | None) -> None:
    evidence = side_evidence(made)
    assert [one.side for one in evidence] == ([] if expected is None else [expected])


def test_streets_on_the_other_side_are_named() -> None:
    made = extract([way(1, 1, 2, driving_side="left", name="Ramp"), way(2, 2, 3), way(3, 3, 4)])
    side = choose_map_side(made, None, None, "map.osm")
    (note,) = exceptions_note(made, lefthand=side.lefthand)
    assert note.startswith("On 1 street of the map, traffic drives on the left") and note.endswith("only: Ramp.")


NETWORK = """<net version="1.20">
<location netOffset="-300000.0,-3900000.0" projParameter="+proj=utm +zone={} +datum=WGS84"/>
<edge id="a" from="1" to="2"><lane id="a_0" index="0" speed="9" length="9" shape="0,0 9,0"/></edge></net>
"""


def test_network_for_the_wrong_side_is_reported(tmp_path: Path) -> None:
    """In Japan; the other one is in Tunisia."""
    (tmp_path / "n.net.xml").write_text(NETWORK.format(54), encoding="utf-8")
    (note,) = sumo_network.read_roads(tmp_path / "n.net.xml", RoadOptions()).notes
    assert note.startswith("Traffic drives on the right in the network, although the map lies in Japan")
    (tmp_path / "n.net.xml").write_text(NETWORK.format(54).replace("<net ", '<net lefthand="true" '), encoding="utf-8")
    assert not sumo_network.read_roads(tmp_path / "n.net.xml", RoadOptions()).notes
    (tmp_path / "n.net.xml").write_text(NETWORK.format(32), encoding="utf-8")
    assert not sumo_network.read_roads(tmp_path / "n.net.xml", RoadOptions()).notes


REAL = Path(__file__).parents[3] / "shared" / "real"


@pytest.mark.skipif(not REAL.is_dir(), reason="real maps are not beside the checkout (shared/real)")
@pytest.mark.parametrize("name", ["osnabrueck.osm.gz", "berlin_neukoelln.osm.gz", "bad_hersfeld.osm"])
def test_real_maps_of_germany(name: str) -> None:
    side = choose_map_side(osm.read_osm(REAL / name), None, None, name)
    assert not side.lefthand and side.note.endswith("the map lies outside the countries with left-hand traffic.")
