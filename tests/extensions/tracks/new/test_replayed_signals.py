"""Recorded people beside simulated vehicles, under the signals that they were recorded under."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from egvs.artefacts.run_record import RunRecord
from egvs.creation.new_scenario import NewScenarioOptions, create_scenario
from egvs.extensions.tracks.new import signal_programs
from egvs.extensions.tracks.new.signal_programs import Replay
from egvs.extensions.tracks.new.signals import GroupOfEdges, RecordedSignals, SignalRecord
from egvs.traffic import sumo
from egvs.traffic.network import read_net_xml
from tests.extensions.tracks.new.test_demand_from_tracks import write_recording
from tests.extensions.tracks.new.test_recorded_signals import write_groups, write_states
from tests.extensions.tracks.new.test_recorded_traffic import HEADER
from tests.traffic.crossing import NETWORK
from tests.traffic.helpers import netgenerate

SIND = Path(__file__).parents[5] / "shared" / "real" / "sind"

MAIN, LEFT = "r3 G10 y3 r24 G12 y3 r25 G10 y3 r7", "r20 u1 G9 y3 r27 u1 G9 y3 r27"
"""100 s of two groups, as ten rows a second; the last state begins at 93 and 73 s."""

FIRST_S = 10.0
"""When the people begin, on the clock of the recording."""


def write_people(path: Path, seconds: int) -> Path:
    """Write a pedestrian who walks north in the west of the junction, one row a second."""
    rows = [f"P1,{k},{1000 * (FIRST_S + k):.0f},pedestrian,-30.0,{k / 10:.1f},,,,," for k in range(seconds + 1)]
    path.write_text("\n".join([HEADER, *rows, ""]), encoding="utf-8")
    return path


def new_with_people(folder: Path, seconds: int = 80) -> Path:
    """Make a scenario with recorded people, signals and their groups."""
    (folder / "map.net.xml").write_text(NETWORK)
    signals = write_states(folder / "states.csv.gz", g1=MAIN, g2=LEFT), write_groups(folder / "groups.csv")
    people = write_people(folder / "people.csv", seconds)
    options = NewScenarioOptions(pedestrian_tracks=(people,), track_crs="world", signals=signals)
    create_scenario(folder / "new", folder / "map.net.xml", options=options)
    return folder / "new"


def simulated_states(network: str, folder: Path, end_s: int) -> list[str]:
    """Return the states of SUMO's signals in each second, from 0 on."""
    (folder / "replay.net.xml").write_text(network)
    (folder / "save.add.xml").write_text(
        '<additional><timedEvent type="SaveTLSStates" source="c" dest="states.xml"/></additional>'
    )
    options = ["-n", "replay.net.xml", "-a", "save.add.xml", "--end", str(end_s), "--no-step-log"]
    sumo.run_program("sumo", options, folder)
    return [element.attrib["state"] for element in ElementTree.parse(folder / "states.xml").iter("tlsState")]


@pytest.mark.slow
@pytest.mark.system
def test_sumo_shows_the_recorded_states_at_their_time(tmp_path: Path) -> None:
    """Second k of the simulation is second k - 290 of the recording; before second 290, a cycle repeats."""
    scenario = new_with_people(tmp_path)
    network = (scenario / "network.net.xml").read_text(encoding="utf-8")
    clock = read_net_xml(scenario / "network.net.xml").signal_clock
    assert clock is not None
    assert (clock.zero_s, clock.from_s, clock.cycle_s) == (FIRST_S - 300.0, 0.0, 40.0)
    assert clock.to_s == pytest.approx(99.9)
    root = ElementTree.fromstring(network)
    index = {each.get("to"): int(each.attrib["linkIndex"]) for each in root.iter("connection") if each.get("tl")}
    states = simulated_states(network, tmp_path, 388)

    def expected(text: str) -> str:
        return "".join(part[0] * int(part[1:]) for part in text.split())

    for target, text in (("out", MAIN), ("north", LEFT)):
        shown = "".join(state[index[target]] for state in states).replace("g", "G")
        assert shown[290:388] == expected(text)[:98]
        assert shown[250:290] == expected(text)[:40]


@pytest.mark.slow
@pytest.mark.system
def test_no_warning_where_people_and_signals_agree(tmp_path: Path, run_egvs) -> None:
    scenario = new_with_people(tmp_path)
    short = ("--set", "traffic.frames=20", "--set", "roi.voxel_m=1")
    code, out, err = run_egvs("traffic", scenario, "--out", tmp_path / "run", *short)
    assert (code, "recorded pedestrians" in out + err) == (0, False)
    summary = RunRecord.read(tmp_path / "run").stages["traffic"].summary
    assert summary["beside_vehicles"]["pedestrian"]["different"] == 1
    assert "recorded pedestrians" not in [warning["rule"] for warning in summary["warnings"]]
    code, out, err = run_egvs("check", scenario, "--set", "traffic.warmup_s=280")
    text = " ".join((out + err).split())
    assert "at the first frame, the recorded signals are 20 s earlier than the people" in text
    assert "Set traffic.warmup_s and begin_s so that their sum is 300" in text


@pytest.mark.slow
@pytest.mark.system
def test_keys_of_the_scenario(tmp_path: Path, run_egvs) -> None:
    (tmp_path / "map.net.xml").write_text(NETWORK)
    people = write_people(tmp_path / "people.csv", 80)
    signals = ["--signals", write_states(tmp_path / "states.csv.gz", g1=MAIN, g2=LEFT)]
    options = ["--pedestrian-tracks", people, "--track-crs", "world"]
    code, _, err = run_egvs("new", tmp_path / "bad", "--from", tmp_path / "map.net.xml", *options, *signals)
    assert code == 2
    assert "recorded road users do not show it either" in err
    assert "the roads are in (west)" in err
    assert not (tmp_path / "bad").exists()
    signals += ["--signals", write_groups(tmp_path / "groups.csv")]
    code, out, _ = run_egvs("new", tmp_path / "new", "--from", tmp_path / "map.net.xml", *options, *signals)
    assert code == 0
    assert "The signals replay the record from 0.0 to 99.9 s on the clock of the tracks" in out
    text = (tmp_path / "new" / "scenario.toml").read_text(encoding="utf-8")
    assert 'pedestrian_tracks = ["tracks/people.csv"]\ntrack_crs = "world"' in text
    assert "frames = 320\nframe_period_s = 0.25\n" in text
    assert "signal plans" not in text


@pytest.mark.slow
@pytest.mark.system
def test_signals_are_guessed_from_vehicles(tmp_path: Path, run_egvs) -> None:
    """25 cars pass the stop line 8.8 to 11.1 s after 10, 30, 50 ... s: in the green around every full 20 s."""
    (tmp_path / "map.net.xml").write_text(NETWORK)
    straight, other = "G3 r13 " + "G7 r13 " * 29 + "G4", "r4 " + "G8 r12 " * 29 + "G8 r8"
    states = write_states(tmp_path / "states.csv.gz", g1=straight, g2=other)
    tracks = write_recording(tmp_path / "tracks.csv")
    options = ["--like", tracks, "--track-crs", "world", "--signals", states]
    code, out, err = run_egvs("new", tmp_path / "new", "--from", tmp_path / "map.net.xml", *options)
    assert (code, err) == (0, "")
    assert "note: Guessed from recorded road users: 1 governs in to out (100 % of 25 vehicles pass in its green" in out
    text = (tmp_path / "new" / "scenario.toml").read_text(encoding="utf-8")
    assert "which recorded light governs which road" in text


@pytest.mark.slow
@pytest.mark.system
def test_signals_are_tested_with_recorded_traffic(tmp_path: Path, run_egvs) -> None:
    """Light 2 is red whenever cars pass, so the groups, or the clocks, are wrong."""
    (tmp_path / "map.net.xml").write_text(NETWORK)
    other = "r4 " + "G8 r12 " * 29 + "G8 r8"
    states = write_states(tmp_path / "states.csv.gz", g1=other, g2=other)
    options = ["--tracks", write_recording(tmp_path / "tracks.csv"), "--track-crs", "world"]
    options += ["--signals", states, "--signals", write_groups(tmp_path / "groups.csv")]
    code, out, err = run_egvs("new", tmp_path / "new", "--from", tmp_path / "map.net.xml", *options)
    assert (code, err) == (0, "")
    assert "note: Recorded traffic does not depend on the signals" in out
    assert "recorded vehicles" in out
    assert "pass the stop line in green or yellow: check the clock and the assignment of the signals" in out


def crossing_record(name: str) -> SignalRecord:
    """Return ten cycles of 60 s: green for 20 s from 0 s (a) or 30 s (b), then 3 s of yellow."""
    start_s = {"a": 0.0, "b": 30.0}[name]
    times_s, states = [-1.0], ["r"]
    for cycle in range(10):
        times_s += [60.0 * cycle + start_s + offset_s for offset_s in (0.0, 20.0, 23.0)]
        states += ["G", "y", "r"]
    return SignalRecord(np.array(times_s), tuple(states), 600.0)


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("replay", [None, Replay(60.0, 300.0, 120.0)], ids=["one cycle", "replay"])
def test_crossings_are_green_while_vehicles_have_red(tmp_path: Path, replay: Replay | None) -> None:
    """A junction with sidewalks: the crossing of a road is never green with a vehicle from it, or 5 s before one."""
    flags = ("--grid", "--grid.number", "1", "--grid.length", "60", "--grid.attach-length", "60")
    netgenerate(tmp_path, *flags, "--sidewalks.guess", "--crossings.guess", "-j", "traffic_light")
    network = (tmp_path / "net.xml").read_text(encoding="utf-8")
    roads = sorted({
        each.attrib["from"] for each in ElementTree.fromstring(network).iter("connection")
        if each.get("tl") == "A0" and not each.attrib["from"].startswith(":")
    })  # fmt: skip
    assert len(roads) == 4
    vertical = [road for road in roads if road.startswith(("top", "bottom"))]
    groups = tuple(GroupOfEdges("a" if road in vertical else "b", road, "") for road in roads)
    records = {name: crossing_record(name) for name in ("a", "b")}
    signals = RecordedSignals(records, (), groups)
    plan = signal_programs.apply_signals(network, "A0", signals, None, "--signals", replay=replay)
    assert "4 crossings without recorded signal: green while the crossed vehicles have red." in plan.notes

    root = ElementTree.fromstring(plan.network)
    crossed = {
        edge.attrib["id"]: edge.attrib["crossingEdges"].split()
        for edge in root.iter("edge") if edge.get("function") == "crossing"
    }  # fmt: skip
    links = [each.attrib for each in root.iter("connection") if each.get("tl") == "A0"]
    logic = root.find("tlLogic[@id='A0']")
    assert logic is not None
    states = "".join
    steps = [
        phase.attrib["state"]
        for phase in logic.iter("phase")
        for _ in range(round(10 * float(phase.attrib["duration"])))
    ]
    assert len(crossed) == 4
    for link in links:
        if link["to"] not in crossed:
            continue
        walk = states(step[int(link["linkIndex"])] for step in steps)
        assert set(walk) == {"G", "r"}
        from_road = [int(each["linkIndex"]) for each in links if each["from"] in crossed[link["to"]]]
        assert from_road
        for vehicle in from_road:
            drive = states(step[vehicle] for step in steps)
            for k, letter in enumerate(walk):
                if letter == "G":
                    assert set(drive[k : k + 50] + drive[: max(k + 50 - len(drive), 0)]) == {"r"}


@pytest.mark.system
@pytest.mark.slow
def test_chongqing(tmp_path: Path) -> None:
    """Map, pedestrians and signals: lights 1 and 3 govern the roads from north and south, 2 and 4 the others."""
    if not SIND.is_dir():
        pytest.skip(f"{SIND.name} is not beside the checkout (shared/real)")
    options = NewScenarioOptions(
        pedestrian_tracks=(SIND / "chongqing_pedestrians.csv.gz",), signals=(SIND / "chongqing_signals.csv",)
    )
    scenario = create_scenario(tmp_path / "new", SIND / "chongqing_lanelet2.osm", options=options)
    (first, second) = [note for note in scenario.notes if note.startswith("Guessed")]
    assert "vehicle traffic light 1 governs road_-100001, road_-100010 (62 % of the time that 26 people" in first
    assert "vehicle traffic light 2 governs road_-100004, road_-100007 (62 %" in second
    clock = read_net_xml(tmp_path / "new" / "network.net.xml").signal_clock
    assert clock is not None
    assert clock.problem(300.0, 41.241, 1160.961) == ""
    assert clock.cycle_s == pytest.approx(70.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.system
def test_new_scenario_runs_at_once(tmp_path: Path, run_egvs, monkeypatch: pytest.MonkeyPatch) -> None:
    """--run hands the new folder to what egvs run does."""
    folders = []
    monkeypatch.setattr("egvs.cli.app.run", folders.append)
    (tmp_path / "map.net.xml").write_text(NETWORK)
    tracks = write_recording(tmp_path / "tracks.csv")
    options = ["--from", tmp_path / "map.net.xml", "--tracks", tracks, "--track-crs", "world"]
    assert run_egvs("new", tmp_path / "first", *options)[0] == 0
    assert folders == []
    assert run_egvs("new", tmp_path / "second", *options, "--run")[0] == 0
    assert folders == [tmp_path / "second"]
