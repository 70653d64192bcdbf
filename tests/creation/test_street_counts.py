"""Counts by street, side of arrival and turn: the numbers of a crossing that can be checked by hand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from egvs.core.errors import InputError
from egvs.creation import assumed_traffic, junctions, street_counts
from egvs.creation.junctions import StreetJunction, Streets
from egvs.creation.openstreetmap import street_network
from egvs.creation.street_counts import StreetCounts
from egvs.formats import osm
from egvs.report.sections import main_assumptions
from egvs.scenario import loading
from egvs.traffic.movements import MovementNames
from tests.creation.overpass_server import SMALL
from tests.creation.small_maps import MapWay, street, write_map
from tests.installed import needs

FROM_NORTH, FROM_SOUTH, FROM_EAST, FROM_WEST = "-1002#1", "1002#0", "-1001#1", "1001#0"
TO_NORTH, TO_SOUTH, TO_EAST, TO_WEST = "1002#1", "-1002#0", "1001#1", "-1001#0"

Read = Callable[..., StreetCounts]


def largest_junction(path: Path) -> tuple[Streets, StreetJunction]:
    """The largest junction of an OpenStreetMap extract."""
    extract = osm.read_osm(path)
    flags = street_network.netconvert_flags(extract, lefthand=False, walk=False)
    _, streets, _ = street_network.build_network(extract, path, flags)
    junction = junctions.largest_junctions(streets)[0]
    assert junction is not None
    return streets, junction


@pytest.fixture(scope="module")
def crossing() -> tuple[Streets, StreetJunction]:
    """North Street and East Street cross."""
    return largest_junction(SMALL)


@pytest.fixture
def read(crossing: tuple[Streets, StreetJunction], tmp_path: Path) -> Read:
    """Read counts from lines of text."""

    def read_lines(*lines: str, encoding: str = "utf-8") -> StreetCounts:
        path = tmp_path / "counts.csv"
        path.write_text("\n".join(lines) + "\n", encoding=encoding)
        return street_counts.read_junction_counts(path, *crossing)

    return read_lines


def rates(counts: StreetCounts, hour: int = 0) -> dict[tuple[str, str], float]:
    """Vehicles per hour by the ids of both edges."""
    return {(flow.edge or flow.from_edge or "", flow.to_edge or ""): flow.per_hour for flow in counts.hours[hour].flows}


# --- names -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "location",
    [
        "North Street,N,left", "NORTH ST.,north,L", "North  Str.,from north,left",
        ",southbound,left", ",SB,L", ",from the north,LEFT",
    ],
)  # fmt: skip
def test_same_movement_by_any_of_its_names(location: str, read: Read) -> None:
    counts = read("street,approach,turn,count", f"{location},120")
    assert rates(counts) == {(FROM_NORTH, TO_EAST): 120.0}  # a left turn of a southbound vehicle leads east


@pytest.fixture(scope="module")
def bend(tmp_path_factory: pytest.TempPathFactory) -> tuple[Streets, StreetJunction]:
    """Main Street comes from the west and turns north; a slip road without a name goes on to the south."""
    nodes = {1: (-150.0, 0.0), 2: (0.0, 0.0), 3: (0.0, 150.0), 4: (0.0, -150.0)}
    ways = [
        street("Main Street", 1, 2, road_class="primary"),
        street("Main Street", 2, 3, road_class="primary"),
        MapWay((2, 4), {"highway": "primary_link", "oneway": "no"}),
    ]
    return largest_junction(write_map(tmp_path_factory.mktemp("bend") / "bend.osm", nodes, ways))


def test_straight_on_is_the_turn_that_stays_on_the_street(bend: tuple[Streets, StreetJunction], tmp_path: Path) -> None:
    path = tmp_path / "counts.csv"
    path.write_text("street,approach,turn,count\nMain Street,W,straight,120\nslip road,S,left,30\n", encoding="utf-8")
    counts = street_counts.read_junction_counts(path, *bend)
    names = MovementNames(bend[0].network, bend[1].at_m, counts.flows)
    described = {names.describe(flow.from_edge, flow.to_edge): flow.per_hour for flow in counts.flows}
    assert described == {
        "Main Street (west), left to Main Street": 120.0,
        "slip road (south), left to Main Street": 30.0,
    }
    assert "Counted as straight on, since the street bends there: Main Street (west) left." in counts.notes


def test_german_tables_mean_the_same(read: Read) -> None:
    """As counting offices in Germany write them, with a name for each side and turn."""
    german = read(
        "Straße;Zufahrt;Richtung;Beginn;Anzahl",
        "North Str.;Nord;links;07:00;10",
        ";Süd;Geradeaus;07:00;20",
        ";aus Osten;Rechtsabbieger;07:00;5",
        ";Sued;rechts;07:00;7",
        ";north st (Nord);rechts;07:00;3",
        "East Str.;O;g;07:00;9",
        ";N;geradeaus;07:15;1",
    )
    english = read(
        "street,approach,turn,start,count",
        "North Street,N,left,07:00,10",
        ",S,through,07:00,20",
        ",E,right,07:00,5",
        ",S,right,07:00,7",
        ",N,right,07:00,3",
        ",E,through,07:00,9",
        ",N,straight,07:15,1",
    )
    assert (german.hours, german.notes) == (english.hours, english.notes)


@pytest.mark.parametrize(
    ("group", "expected"),
    [("SBL", (FROM_NORTH, TO_EAST)), ("NBT", (FROM_SOUTH, TO_NORTH)), ("ebr", (FROM_WEST, TO_SOUTH))],
)
def test_lane_groups_name_the_heading(group: str, expected: tuple[str, str], read: Read) -> None:
    assert rates(read("lane_group,count", f"{group},60")) == {expected: 60.0}


def test_ids_of_edges_still_work(read: Read) -> None:
    counts = read("edge,from_edge,to_edge,count", f"{FROM_WEST},,,50", f",{FROM_NORTH},{TO_SOUTH},70")
    assert rates(counts) == {(FROM_WEST, ""): 50.0, (FROM_NORTH, TO_SOUTH): 70.0}
    assert counts.describe() == "120 vehicles an hour in 1 movement and 1 approach without turns, counted (counts.csv)"


# --- numbers ---------------------------------------------------------------------------------------------------------
def test_approach_count_is_divided_by_the_assumed_shares(read: Read, crossing: tuple[Streets, StreetJunction]) -> None:
    streets, junction = crossing
    flows = junctions.assumed_flows(streets, junctions.region_around(junction))
    assumed = {flow.to_edge: flow.per_hour for flow in flows if flow.from_edge == FROM_SOUTH}
    counts = read("approach,count", "S,300")
    for (_, to_edge), per_hour in rates(counts).items():
        assert per_hour == pytest.approx(300 * assumed[to_edge] / sum(assumed.values()), abs=0.05)
    assert sum(rates(counts).values()) == pytest.approx(300, abs=0.2)
    assert counts.assumptions == [
        "turns of the approaches North Street (south)",
        "no vehicles in uncounted movements: North Street (north), East Street (east), East Street (west)",
    ]
    assert "divided by the assumed shares: North Street (south)" in counts.notes[0]


def test_quarter_hours_become_vehicles_per_hour_of_each_hour(read: Read) -> None:
    rows = [f"N,left,{start},{n}" for start, n in (("07:00", 10), ("07:15", 20), ("07:30", 30), ("07:45", 15))]
    counts = read("approach,turn,start,count", *rows, "N,left,08:00,7", "N,left,08:15,9")
    assert [(hour.name, rates(counts, number)) for number, hour in enumerate(counts.hours)] == [
        ("07-08", {(FROM_NORTH, TO_EAST): 75.0}),
        ("08-09", {(FROM_NORTH, TO_EAST): 32.0}),  # 16 in half an hour
    ]
    assert counts.notes[0] == (
        "Counts of a part of the hour 08-09 are scaled up to an hour for 1 movement:"
        " North Street (north) left (30 min)."
    )
    assert "hour 07-08" not in str(counts.notes)


def test_note_on_scaled_counts_names_four_movements_and_how_many_more(read: Read) -> None:
    """Six movements were counted for a quarter of an hour, and one for the complete hour."""
    partial = ["N,left", "N,through", "N,right", "S,left", "S,through", "S,right"]
    rows = [f"{move},07:00,5" for move in partial]
    rows += [f"E,through,07:{minute:02d},10" for minute in (0, 15, 30, 45)]
    (note,) = [text for text in read("approach,turn,start,count", *rows).notes if "scaled up" in text]
    assert note == (
        "Counts of a part of the hour 07-08 are scaled up to an hour for 6 movements:"
        " North Street (north) left (15 min), North Street (north) straight (15 min),"
        " North Street (north) right (15 min), North Street (south) left (15 min) and 2 more."
    )


def test_columns_named_by_their_start_mean_the_same_as_rows(read: Read) -> None:
    wide = read("approach;turn;07:00;07:15", "N;left;10;20", "S;right;1;2")
    long = read("approach,turn,start,count", "N,left,07:00,10", "N,left,7:15,20", "S,right,07:00,1", "S,right,0715,2")
    assert (wide.hours, wide.notes) == (long.hours, long.notes)
    assert rates(wide)[FROM_NORTH, TO_EAST] == 60.0


def test_hourly_counts_and_kinds(read: Read) -> None:
    counts = read("approach,turn,start,count,kind", "E,right,07:00,50,", "E,right,08:00,60,", "E,right,08:00,6,truck")
    assert [[(flow.kind, flow.per_hour) for flow in hour.flows] for hour in counts.hours] == [
        [("", 50.0)],
        [("", 60.0), ("truck", 6.0)],
    ]


def test_hours_without_a_vehicle_are_left_out_with_a_note(read: Read) -> None:
    counts = read("approach,turn,start,count", "N,left,02:00,0", "N,left,03:00,0", "N,left,07:00,40", "N,left,08:00,9")
    assert [hour.name for hour in counts.hours] == ["07-08", "08-09"]
    assert "Hours without a vehicle are left out: 02-03, 03-04." in counts.notes


def test_movements_without_a_count_are_named(read: Read) -> None:
    lines = ["approach,turn,count", "N,,10", "S,,10", "E,,10", "W,left,10", "W,right,10"]
    counts = read(*lines)
    assert "Movements without a count get no vehicles: East Street (west) straight." in counts.notes
    assert counts.assumptions[-1] == "no vehicles in uncounted movements: East Street (west) straight"
    hours = read("approach,turn,start,count", "N,,07:00,9", "N,,08:00,9", "S,,07:00,9", "E,,07:00,9", "W,,07:00,9")
    assert hours.assumptions[-1] == "no vehicles in uncounted movements: those of 08-09"
    assert not any("uncounted" in text for text in read("approach,count", "N,9", "S,9", "E,9", "W,9").assumptions)


def test_warns_of_counts_that_lanes_cannot_carry(read: Read) -> None:
    def warnings(*lines: str) -> list[str]:
        counts = read("approach,turn,count,kind", *lines)
        return [text.partition("counts.csv: ")[2] for text in counts.warnings(Path("scenario.toml"))]

    assert warnings("N,left,1900,", "S,left,1000,") == []
    assert warnings("N,left,1900,", "N,left,1980,truck", "S,left,1000,") == [
        "North Street (north) left: 3,880 vehicles an hour exceed what 1 lane can carry, at most 2,000."
        " Check the count."
    ]
    assert warnings("N,left,1100,", "N,right,1100,") == [
        "North Street (north): 2,200 vehicles an hour exceed what 1 lane can carry, at most 2,000. Check the count."
    ]


# --- the scenario ----------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_scenario_has_the_counts_as_periods(tmp_path: Path, run_egvs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assumed_traffic, "find_capacity", lambda *_: pytest.fail("counts are not reduced"))
    (tmp_path / "c.csv").write_text("approach,turn,start,count\nN,left,07:00,40\nN,left,08:00,80\nS,,08:00,90\n")
    code, printed, error = run_egvs("new", tmp_path / "new", "--osm", SMALL, "--counts", tmp_path / "c.csv")
    assert (code, error) == (0, "")
    printed = " ".join(printed.split())
    assert "traffic vehicles an hour in 4 movements, counted (c.csv): 07-08 40, 08-09 170" in printed
    assert "Movements that were not counted in an hour get no vehicles in it: 07-08." in printed
    assert "the traffic is assumed" not in printed
    scenario = loading.load(tmp_path / "new")
    assert [period.name for period in scenario.traffic.periods] == ["07-08", "08-09"]
    assert scenario.traffic.periods[0].counts[0].per_hour == 40.0
    assert "turns of the approaches North Street (south)" in scenario.assumed
    assert not [text for text in scenario.assumed if text.startswith("traffic")]


@pytest.mark.slow
def test_counts_of_one_hour_are_no_period(tmp_path: Path, run_egvs: Any) -> None:
    (tmp_path / "c.csv").write_text("approach,turn,count\nN,left,3880\n")
    code, printed, _ = run_egvs("new", tmp_path / "new", "--osm", SMALL, "--counts", tmp_path / "c.csv")
    assert code == 0 and "North Street (north) left: 3,880 vehicles an hour exceed what" in " ".join(printed.split())
    scenario = loading.load(tmp_path / "new")
    traffic = scenario.traffic
    assert (traffic.periods, [count.per_hour for count in traffic.counts]) == ((), [3880.0])
    assert main_assumptions(scenario.assumed) == (
        "Assumed, not measured: no vehicles in uncounted movements: North Street (north) right and others;"
        " positions of the poles; 4 more."
    )
    text = (tmp_path / "new" / "scenario.toml").read_text()
    assert "North Street (north), left to East Street" in text


# --- bad input -------------------------------------------------------------------------------------------------------
TURNS = r"\(left, right, straight\)"
NAMES = (
    rf"The approaches are: North Street \(north\) {TURNS}; East Street \(east\) {TURNS};"
    rf" North Street \(south\) {TURNS}; East Street \(west\) {TURNS}\."
)
HEAD = "street,approach,turn,start,count"
BAD: dict[str, tuple[list[str], str]] = {
    "empty": ([""], r"expected a header and rows, got no values"),
    "no rows": ([HEAD], r"counts.csv: has no counts"),
    "unknown column": (["street,aproach,count", "a,N,1"], r"header: unknown column 'aproach'. Did you mean approach\?"),
    "unknown columns": (
        ["Straße,Arm,Farbe,Anzahl", "a,N,rot,1"],
        r"header: unknown columns 'Arm', 'Farbe'. Columns: street, approach, turn, lane_group",
    ),
    "two columns": (["street,street,count", "a,b,1"], r"two columns are called 'street'"),
    "no number": (["street,approach", "a,N"], r"expected a column count, or columns named by their start, got none"),
    "both": (["approach,count,07:00", "N,1,1"], r"got both"),
    "no location": (["count", "1"], r"no column gives the location of the counts"),
    "empty location": ([HEAD, ",,left,,5"], r"line 2: has no location"),
    "unknown street": ([HEAD, "High St,,,,5"], rf"line 2: no approach of the junction is called 'High St'. {NAMES}"),
    "ambiguous street": (
        [HEAD, "North Street,,left,,5"],
        rf"may be North Street \(north\) or North Street \(south\). Give street and approach. {NAMES}",
    ),
    "contradiction": ([HEAD, "North Street,W,left,,5"], rf"no approach .* is 'North Street from the west'. {NAMES}"),
    "unknown side": ([HEAD, ",up,left,,5"], r"line 2: approach: expected the side on which .* got 'up'"),
    "between two": ([HEAD, ",NE,left,,5"], r"'from the north-east' may be"),
    "unknown turn": ([HEAD, ",N,sideways,,5"], r"line 2: turn: expected left, straight, right, U-turn or all"),
    "no such turn": ([HEAD, ",N,u-turn,,5"], rf"North Street .* has no movement U-turn\. Correct .*{NAMES}"),
    "unknown group": (["lane_group,count", "XBL,5"], r"line 2: lane_group: expected a lane group such as NBL or EBTR"),
    "negative": ([HEAD, ",N,left,,-5"], r"line 2: count: expected a number of vehicles of 0 to 100,000, got '-5'"),
    "text": ([HEAD, ",N,left,,many"], r"count: expected a number of vehicles .* got 'many'"),
    "nan": ([HEAD, ",N,left,,nan"], r"count: expected a number of vehicles .* got 'nan'"),
    "all zero": ([HEAD, ",N,left,,0"], r"all counts are 0"),
    "time": ([HEAD, ",N,left,25:00,5"], r"line 2: start: expected a time of the day, got '25:00'"),
    "one start": ([HEAD, ",N,left,07:00,5"], r"intervals of one length .* got a single start. Add a column min"),
    "odd interval": ([HEAD, ",N,left,07:00,5", ",N,left,07:07,5"], r"expected intervals of one length .* got 7"),
    "across an hour": ([HEAD, ",N,left,07:30,5", ",N,left,08:30,5"], r"interval of 60 minutes ends in another hour"),
    "some starts": ([HEAD, ",N,left,07:00,5", ",S,left,,5"], r"only some rows have a start"),
    "minutes": (["approach,turn,start,minutes,count", "N,left,07:00,7,1"], r"minutes: expected one of 5, 10, 15"),
    "no starts": (["approach,turn,minutes,count", "N,left,15,30"], r"minutes has no effect without a start. Add a"),
    "twice": (
        [HEAD, "North St,N,left,,5", ",N,left,,6"],
        r"line 3: N left is counted twice, also in line 2",
    ),
    "twice by approach": ([HEAD, ",N,,,5", ",N,left,,6"], r"line 3: N left is counted twice, also in line 2"),
    "unknown kind": (["approach,count,kind", "N,5,tram"], r"kind: expected a kind of the fleet, got 'tram'"),
    "unknown edge": (["edge,count", "77,5"], r"line 2: edge: the network has no edge '77'"),
    "one edge": (["from_edge,to_edge,count", f"{FROM_NORTH},,5"], r"expected either edge, or from_edge and to_edge"),
    "edge and street": (["edge,street,count", f"{FROM_NORTH},North St,5"], r"names a street and an edge"),
    "thousands": (["approach;count", "N;1.500"], r"line 2: count: 1.500 can mean 1.5 or 1500"),
    "underscore": (["approach,count", "N,1_0"], r"line 2: count: expected a number of vehicles"),
    "few values": ([HEAD, ",N,left,5"], r"line 2: expected 5 values, got 4"),
    "quotes": ([HEAD, '"N"x,,,,5'], r"is not CSV"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_counts_give_one_message(name: str, read: Read) -> None:
    lines, expected = BAD[name]
    with pytest.raises(InputError, match=expected):
        read(*lines)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
def test_encodings_of_spreadsheets_give_the_same_counts(read: Read, encoding: str) -> None:
    rows = ("street;approach;count", ";N;5", ";S;7")
    expected = read(*rows)
    assert rates(expected)
    assert rates(read(*rows, encoding=encoding)) == rates(expected)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--traffic", "light"], "--traffic: has no effect on counted traffic"),
        (["--vehicles-per-hour", "9"], "--vehicles-per-hour: has no effect on counted traffic"),
        pytest.param(["--like", "tracks.csv"], "--counts: cannot be combined with --like", marks=needs("tracks")),
        ([], "missing.csv: cannot be read"),
    ],
)
def test_wrong_options_write_nothing(words: list[str], expected: str, tmp_path: Path, run_egvs: Any) -> None:
    outcome = run_egvs("new", tmp_path / "new", "--osm", SMALL, "--counts", tmp_path / "missing.csv", *words)
    assert outcome[0] == 2
    assert expected in " ".join(outcome[2].split())
    assert not (tmp_path / "new").exists()
