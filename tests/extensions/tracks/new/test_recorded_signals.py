"""Recorded signals: reading them, and the program that they become."""

from __future__ import annotations

import gzip
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.creation.new_scenario import NewScenarioOptions, create_scenario
from egvs.extensions.tracks.new import signal_programs
from egvs.extensions.tracks.new import signals as recorded_signals
from egvs.extensions.tracks.new.signals import RecordedSignals, SignalRecord, read_signals
from egvs.formats.georeference import WorldFrame
from egvs.traffic import sumo
from tests.extensions.tracks.new.test_demand_from_tracks import write_recording
from tests.traffic.crossing import NETWORK

STATES = {"r": "STOP_AND_REMAIN", "u": "PRE_MOVEMENT", "G": "PERMISSIVE_MOVEMENT_ALLOWED", "y": "PERMISSIVE_CLEARANCE"}

MAIN, LEFT = "r3 G10 y3 r24 G12 y3 r25 G10", "r20 u1 G9 y3 r27 u1 G9 y3 r17"
"""Two groups: state and seconds. Green begins at 3, 40 and 80 s, and at 21 and 61 s: cycles of 37, 40 and 40 s."""


def write_states(path: Path, **groups: str) -> Path:
    """Write states in TAF-BW's form, ten a second, gzipped."""
    rows = ["signal_group_id,timestamp_ms,movement_state"]
    for name, text in groups.items():
        states = [state for part in text.split() for state in [part[0]] * (10 * int(part[1:]))]
        rows += [f"{name.removeprefix('g')},{100 * k},{STATES[state]}" for k, state in enumerate(states)]
    path.write_bytes(gzip.compress("\n".join([*rows, ""]).encode()))
    return path


def write_groups(path: Path) -> Path:
    path.write_text("group,from_edge,to_edge\n1,in,out\n2,in,north\n", encoding="utf-8")
    return path


@pytest.fixture
def signals(tmp_path: Path) -> RecordedSignals:
    states = write_states(tmp_path / "states.csv.gz", g1=MAIN, g2=LEFT)
    return read_signals([states, write_groups(tmp_path / "groups.csv")])


def straight_link(index: int, from_edge: str, to_edge: str, path_m: FloatArray) -> signal_programs._Link:
    return signal_programs._Link(index, from_edge, to_edge, path_m, path_m[:2], path_m[-2:])


def test_states_of_taf_bw(signals: RecordedSignals) -> None:
    record = signals.records["1"]
    assert "".join(record.states) == "rGyrGyrG"
    assert record.starts_s == pytest.approx([0, 3, 13, 16, 40, 52, 55, 80])
    assert record.green_starts_s == pytest.approx([3, 40, 80])
    assert record.green_durations_s == pytest.approx([10, 12])
    assert [record.state_at(time_s) for time_s in (0.0, 2.99, 3.0, 13.0, 89.9)] == ["r", "r", "G", "y", "G"]


def test_changes_of_sind(tmp_path: Path) -> None:
    """Rows are changes; a row without a time is the state before the recording."""
    header = "RawFrameID,timestamp(ms),Vehicle Traffic light 1,Traffic light 2"
    rows = ["0,,0,0", "30,1000,1,0", "90,3000,3,0", "180,6000,0,1"]
    (tmp_path / "lights.csv").write_text("\n".join([header, *rows, ""]))
    (tmp_path / "groups.csv").write_text("group,from_edge,to_edge\nVehicle Traffic light 1,in,\n")
    result = read_signals([tmp_path / "lights.csv", tmp_path / "groups.csv"])
    assert {name: "".join(record.states) for name, record in result.records.items()} == {
        "vehicle traffic light 1": "Gyr", "traffic light 2": "rG",
    }  # fmt: skip
    assert result.records["vehicle traffic light 1"].starts_s.tolist() == [1.0, 3.0, 6.0]
    assert result.edges == (recorded_signals.GroupOfEdges("vehicle traffic light 1", "in", ""),)


KML = """<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Folder>
{lanes}</Folder></Document></kml>"""
LANE = """<Placemark><LineString><coordinates>{points}</coordinates></LineString><ExtendedData>
<Data name="Source"><value>{source}</value></Data><Data name="Sink"><value>{sinks}</value></Data>
<Data name="SignalGroup"><value>{groups}</value></Data></ExtendedData></Placemark>"""


def test_groups_of_kml(tmp_path: Path) -> None:
    """The lane of the approach begins at its stop line; groups are those of its sinks, in order."""
    frame = WorldFrame("EPSG:32632", (-500000.0, -5400000.0))

    def lane(source: str, sinks: str, groups: str, *points_m: tuple[float, float]) -> str:
        degrees = frame.to_degrees(np.array(points_m))
        points = " ".join(f"{lon:.9f},{lat:.9f},0" for lon, lat in degrees.tolist())
        return LANE.format(points=points, source=source, sinks=sinks, groups=groups)

    lanes = [
        lane("1", "2, 3", "1, 2", (-12.0, 1.0), (-100.0, 1.0)),
        lane("2", "", "", (12.0, 1.0), (100.0, 1.0)),
        lane("3", "", "", (1.0, 12.0), (1.0, 100.0)),
    ]
    (tmp_path / "map.kml").write_text(KML.format(lanes="".join(lanes)))
    result = read_signals([write_states(tmp_path / "states.csv.gz", g1=MAIN, g2=LEFT), tmp_path / "map.kml"])
    assert [way.group for way in result.ways] == ["1", "2"]
    line = np.array([(-110.0, 0.0), (110.0, 0.0)]), np.array([(-110.0, 0.0), (0.0, 0.0), (0.0, 110.0)])
    links = [straight_link(index, "a", f"b{index}", path_m) for index, path_m in enumerate(line)]
    assert signal_programs._assign_groups(links, result, frame) == {0: "1", 1: "2"}


def test_typical_cycle_has_green_for_all_groups(signals: RecordedSignals) -> None:
    """The median of 37, 40 and 40 s is 40 s; group 1 has such a cycle from 40 s on, in which group 2 has green too."""
    records = list(signals.records.values())
    cycles = signal_programs._cycles(records)
    assert [cycle.length_s for cycle in cycles] == pytest.approx([37.0, 40.0, 40.0])
    cycle = signal_programs._typical_cycle(cycles, 40.0, records)
    assert cycle.length_s == pytest.approx(40.0)
    assert cycle.begin_s == pytest.approx(21.0)


def test_breaks_and_flicker_are_no_cycles() -> None:
    starts_s = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 64.0, 65.0, 1000.0])
    record = SignalRecord(starts_s, tuple("rGrGrGrG"), 1010.0)
    assert [cycle.length_s for cycle in signal_programs._cycles([record])] == [61.0]


def test_cycle_that_ends_in_green_gets_yellow() -> None:
    states = ["r"] * 50 + ["G"] * 50
    result = signal_programs._with_yellow(states)
    assert "".join(result) == "r" * 50 + "G" * 20 + "y" * 30


@pytest.mark.slow
@pytest.mark.system
def test_program_of_the_network(tmp_path: Path, signals: RecordedSignals) -> None:
    """The recorded cycle from 21 s on, state by state; the junction had no lights before."""
    plan = signal_programs.apply_signals(NETWORK, "c", signals, None, "--signals")
    root = ElementTree.fromstring(plan.network)
    logic = root.find("tlLogic")
    assert logic is not None
    index = {each.get("to"): int(each.attrib["linkIndex"]) for each in root.iter("connection") if each.get("tl")}
    assert set(index) == {"out", "north"}
    time_s, rows = 0.0, []
    for phase in logic.iter("phase"):
        time_s += float(phase.attrib["duration"])
        state = phase.attrib["state"]
        rows.append((round(time_s, 1), state[index["out"]] + state[index["north"]]))
    assert rows == [
        (9.0, "rG"), (12.0, "ry"), (19.0, "rr"), (31.0, "Gr"), (34.0, "yr"), (39.0, "rr"), (40.0, "ru"),
    ]  # fmt: skip
    assert (
        "The signals repeat a recorded cycle of 40.0 s; median of 3 recorded cycles 40.0 s (37.0 to 40.0 s)."
        in plan.notes
    )
    (tmp_path / "plan.net.xml").write_text(plan.network)
    sumo.run_program("sumo", ["-n", "plan.net.xml", "--end", "100", "--no-step-log"], tmp_path)


@pytest.mark.slow
@pytest.mark.system
def test_scenario_with_recorded_signals(run_egvs, tmp_path: Path) -> None:
    (tmp_path / "map.net.xml").write_text(NETWORK)
    states = write_states(tmp_path / "states.csv.gz", g1=MAIN, g2=LEFT)
    tracks, groups = write_recording(tmp_path / "tracks.csv"), write_groups(tmp_path / "groups.csv")
    options = ["--like", tracks, "--track-crs", "world", "--signals", states, "--signals", groups]
    code, out, err = run_egvs("new", tmp_path / "new", "--from", tmp_path / "map.net.xml", *options)
    assert (code, err) == (0, "")
    assert "The signals repeat a recorded cycle of 40.0 s" in out
    text = (tmp_path / "new" / "scenario.toml").read_text(encoding="utf-8")
    assert "# network.net.xml: The signals repeat a recorded cycle of 40.0 s" in text
    assert "signal plans" not in text
    assert "<tlLogic" in (tmp_path / "new" / "network.net.xml").read_text(encoding="utf-8")


def test_green_that_crosses_another_gives_way() -> None:
    """Link 1 gives way to link 0; where both are green, it gets the letter for that."""
    letters = signal_programs._with_right_of_way(["G", "G", "r"], {0: "a", 1: "b", 2: "c"}, {1: {0}, 2: {0}})
    assert "".join(letters) == "Ggr"
    letters = signal_programs._with_right_of_way(["y", "G", "r"], {0: "a", 1: "b", 2: "c"}, {1: {0}, 2: {0}})
    assert "".join(letters) == "ygr"  # vehicles still come in yellow


def test_dark_group_governs_nothing() -> None:
    dark = SignalRecord(np.array([0.0]), (recorded_signals.DARK,), 10.0)
    group = recorded_signals.GroupOfEdges("1", "in", "out")
    link = straight_link(0, "in", "out", np.array([(0.0, 0.0), (1.0, 0.0)]))
    assert signal_programs._assign_groups([link], RecordedSignals({"1": dark}, (), (group,)), None) == {}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("a,b\n1,2\n", "neither recorded states of signals nor an assignment of signal groups"),
        (
            "signal_group_id,timestamp_ms,movement_state\n1,0,BLUE\n",
            "expected a state such as STOP_AND_REMAIN, got 'BLUE'",
        ),
        ("signal_group_id,timestamp_ms,movement_state\n1,x,DARK\n", "expected a number, got 'x'"),
        ("timestamp(ms),Traffic light 1\n,1\n", "no row has a time"),
        ("timestamp(ms),Traffic light 1\n0,7\n", "expected 0, 1 or 3, got '7'"),
        ("group,from_edge,to_edge\n1,in,out\n", "no file has recorded states of signals"),
    ],
)
def test_rejects_damaged_files(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "signals.csv").write_text(content)
    with pytest.raises(InputError) as error:
        read_signals([tmp_path / "signals.csv"])
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("lanes", "message"),
    [
        (
            LANE.format(points="8.4,49.0", source="1", sinks="9", groups="1"),
            "lane 1 leads to lane '9', which is missing",
        ),
        (LANE.format(points="8.4,north", source="1", sinks="1", groups="1"), "a lane has no valid coordinates"),
    ],
)
def test_rejects_damaged_kml(tmp_path: Path, lanes: str, message: str) -> None:
    (tmp_path / "map.kml").write_text(KML.format(lanes=lanes))
    with pytest.raises(InputError, match=message):
        read_signals([tmp_path / "map.kml"])


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize(
    ("states", "groups", "message"),
    [
        ({"g1": MAIN}, "group,from_edge,to_edge\n1,a,b\n", "no signal group governs a connection of the junction c"),
        ({"g1": "r5 G10 y3"}, "group,from_edge,to_edge\n1,in,out\n", "no complete cycle of the signals is recorded"),
    ],
)
def test_rejects_signals_that_do_not_fit(tmp_path: Path, states: dict[str, str], groups: str, message: str) -> None:
    (tmp_path / "map.net.xml").write_text(NETWORK)
    (tmp_path / "groups.csv").write_text(groups)
    files = (write_states(tmp_path / "states.csv.gz", **states), tmp_path / "groups.csv")
    options = NewScenarioOptions(like=(write_recording(tmp_path / "tracks.csv"),), track_crs="world", signals=files)
    with pytest.raises(InputError, match=message):
        create_scenario(tmp_path / "new", tmp_path / "map.net.xml", options=options)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
@pytest.mark.system
def test_kml_needs_a_map_with_a_reference_system(tmp_path: Path) -> None:
    (tmp_path / "map.net.xml").write_text(NETWORK)
    (tmp_path / "map.kml").write_text(
        KML.format(lanes=LANE.format(points="8.4,49.0", source="1", sinks="1", groups="1"))
    )
    files = (write_states(tmp_path / "states.csv.gz", g1=MAIN), tmp_path / "map.kml")
    options = NewScenarioOptions(like=(write_recording(tmp_path / "tracks.csv"),), track_crs="world", signals=files)
    message = "the map has no reference system, so lanes in longitude and latitude cannot be assigned to its roads"
    with pytest.raises(InputError, match=message):
        create_scenario(tmp_path / "new", tmp_path / "map.net.xml", options=options)
