"""Signal plans: what a plan becomes in SUMO, and each wrong plan with its message.

Evidence: states that a person can check at a crossing of two streets, SUMO's states second by second over TraCI, and
the network's foes for conflicts.
"""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from egvs.core.digests import Digests, use_digests
from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.creation import sumo_network
from egvs.creation.map_parts import RoadOptions
from egvs.scenario.loading import scenario_from_dict
from egvs.scenario.signal_config import SignalConfig, SignalPhaseConfig
from egvs.scenario.traffic_config import TrafficConfig
from egvs.stages import check, traffic
from egvs.traffic import directions, network, signal_descriptions, signal_plans, signals, sumo, sumo_folder
from tests.installed import needs
from tests.stage_runner import run_stage
from tests.traffic.helpers import netgenerate

pytestmark = pytest.mark.system

NS = {"green": {"north": ["all"], "south": ["all"]}, "green_s": 30}
EW = {"green": {"east": ["straight", "right", "left"], "west": ["all"]}, "green_s": 20}


@pytest.fixture(scope="module")
def crossing(tmp_path_factory):
    """One signalised crossing of two streets, with names, sidewalks and pedestrian crossings."""
    folder = tmp_path_factory.mktemp("crossing")
    nodes = {"c": (0, 0), "n": (0, 200), "e": (200, 0), "s": (0, -200), "w": (-200, 0)}
    listed = "".join(
        f'<node id="{name}" x="{x}" y="{y}" type="{"traffic_light" if name == "c" else "priority"}"/>'
        for name, (x, y) in nodes.items()
    )
    streets = {"n": "Mill Lane", "s": "Mill Lane", "e": "High Street", "w": "High Street"}
    edges = "".join(
        f'<edge id="{name}{way}" from="{a}" to="{b}" name="{streets[name]}" numLanes="2" sidewalkWidth="2"/>'
        for name in "nesw"
        for way, a, b in (("in", name, "c"), ("out", "c", name))
    )
    (folder / "n.nod.xml").write_text(f"<nodes>{listed}</nodes>")
    (folder / "e.edg.xml").write_text(f"<edges>{edges}</edges>")
    flags = ["-n", "n.nod.xml", "-e", "e.edg.xml", "--crossings.guess", "--no-turnarounds", "--output.street-names",
             "--offset.disable-normalization"]  # fmt: skip
    sumo.run_netconvert(flags, folder, "net.net.xml")
    return folder


def scenario(folder, plans, **keys):
    """A scenario with plans; its region is the junction at (0, 0)."""
    values = {
        "name": "crossing",
        "roi": {"center_m": [0, 0, 2.5], "size_m": [60, 60, 5], "voxel_m": 1.0},
        "sites": {"grid": {"low_m": [0, 0], "high_m": [1, 1], "spacing_m": 1, "heights_m": [3]}},
        "tpog": {"blocks": 1},
        "traffic": {"network": "net.net.xml", "vehicles": 6, "frames": 40, "warmup_s": 20.0, "signals": plans, **keys},
    }
    return scenario_from_dict(values, folder, str(folder / "scenario.toml"))


def programs(folder, plans):
    """The programs of plans, by signal."""
    path = folder / "net.net.xml"
    return signal_plans._programs(scenario(folder, plans), path, network.read_net_xml(path))


def read_crossing(folder):
    (signal,) = signals.read_signals(folder / "net.net.xml", network.read_net_xml(folder / "net.net.xml"))
    return signal


def letters(folder, state):
    """The letters of a state by approach and movement."""
    found = {}
    for link in read_crossing(folder).links:
        found.setdefault(link.title, set()).add(state[link.index])
    return {title: "".join(sorted(each)) for title, each in found.items()}


def test_approaches_are_named_by_side_and_street(crossing):
    signal = read_crossing(crossing)
    assert set(signal.approaches) == {
        "Mill Lane (north)", "High Street (east)", "Mill Lane (south)", "High Street (west)",
    }  # fmt: skip
    assert all(set(m) == {"left", "straight", "right", "crosswalk"} for m in signal.approaches.values())
    assert set(signal.streets) == {"Mill Lane", "High Street"}


def test_plan_by_hand(crossing):
    """Two phases of 30 s and 20 s, each with 3 s of yellow and 2 s of all-red: 60 s."""
    program = programs(crossing, {"c": {"phases": [NS, EW], "offset_s": 7, "cycle_s": 60}})["c"]
    assert [phase.duration_s for phase in program.phases] == [30, 3, 2, 20, 3, 2]
    assert (program.type, program.offset_s, program.cycle_s) == ("static", 7, 60)
    first = letters(crossing, program.phases[0].state)
    # left turns give way to oncoming traffic, right turns to people; both cross the side streets' crossings
    assert first["Mill Lane (north) straight"] == "G"
    assert first["Mill Lane (north) left"] == first["Mill Lane (north) right"] == "g"
    assert first["High Street (east) straight"] == first["High Street (west) left"] == "r"
    assert first["High Street (east) crosswalk"] == "G"  # people walk along Mill Lane, over the arms of High Street
    assert first["Mill Lane (north) crosswalk"] == "r"
    yellow = letters(crossing, program.phases[1].state)
    assert yellow["Mill Lane (north) straight"] == yellow["Mill Lane (south) left"] == "y"
    assert yellow["High Street (east) crosswalk"] == "r"
    assert set(program.phases[2].state) == {"r"}


def test_green_in_two_phases_is_not_interrupted(crossing):
    """North alone, then north and south: north keeps its green through yellow and all-red of nobody."""
    plan = [{"green": {"north": ["all"]}, "green_s": 10}, NS, EW]
    program = programs(crossing, {"c": {"phases": plan}})["c"]
    north = [letters(crossing, phase.state)["Mill Lane (north) straight"] for phase in program.phases]
    south = [letters(crossing, phase.state)["Mill Lane (south) straight"] for phase in program.phases]
    assert north == ["G", "G", "G", "G", "y", "r", "r", "r", "r"]
    assert south == ["r", "r", "r", "G", "y", "r", "r", "r", "r"]


def test_left_turn_gives_way_to_oncoming_yellow(crossing):
    """North keeps its green while the oncoming vehicles have yellow: they may still come, so no right of way."""
    alone = {"green": {"north": ["all"]}, "green_s": 10}
    program = programs(crossing, {"c": {"phases": [NS, alone, EW]}})["c"]
    both, yellow, all_red, after = (letters(crossing, phase.state) for phase in program.phases[:4])
    assert yellow["Mill Lane (south) straight"] == "y"
    assert [state["Mill Lane (north) left"] for state in (both, yellow)] == ["g", "g"]
    assert [state["Mill Lane (north) straight"] for state in (both, yellow, all_red, after)] == ["G"] * 4


def test_position_of_two_links_gives_way_if_one_of_them_does():
    """Left and straight share position 0; the left turn gives way to position 1, whichever comes last."""
    north = np.array([0.0, -1.0])
    left = signals.Link(0, "north", "left", "a", "", north, frozenset({1}), frozenset({1}))
    straight = signals.Link(0, "north", "straight", "a", "", north)
    oncoming = signals.Link(1, "south", "straight", "b", "", -north, frozenset({0}))
    for links in ((left, straight, oncoming), (straight, left, oncoming)):
        signal = signals.Signal("c", ("c",), (0.0, 0.0), links, signals.Program("static", 0.0, ()))
        assert signal_plans.state_of({0, 1}, signal) == "gG"
        assert signal_plans.state_of({0}, signal) == "Gr"
        assert signal_plans.state_of({0}, signal, {1}) == "gy"


@pytest.mark.parametrize("name", ["c", "Mill Lane / High Street", "high st & Mill Ln."])
def test_signal_by_id_or_streets(crossing, name):
    assert list(programs(crossing, {name: {"phases": [NS, EW]}})) == ["c"]


def test_edges_and_full_names_are_approaches(crossing):
    plan = [{"green": {"nin": ["all"], "Mill Lane (south)": ["thru", "L", "right"]}, "green_s": 30}, EW]
    assert programs(crossing, {"c": {"phases": plan}}) == programs(crossing, {"c": {"phases": [NS, EW]}})
    plan = [{"green": {"N (Mill Ln.)": ["all"], "South Mill Lane": ["all"]}, "green_s": 30}, EW]
    assert programs(crossing, {"c": {"phases": plan}}) == programs(crossing, {"c": {"phases": [NS, EW]}})
    plan = [{"green": {"southbound": ["all"], "S": ["all"]}, "green_s": 30}, EW]
    assert programs(crossing, {"c": {"phases": plan}}) == programs(crossing, {"c": {"phases": [NS, EW]}})


def test_csv_and_sumo_file_give_the_same_program(crossing, tmp_path):
    shutil.copy(crossing / "net.net.xml", tmp_path)
    rows = ["phase,approach,movement,green_s", "main,north,all,30", "main,south,all,", "side,east,straight right,20",
            "side,east,left,20", "side,west,all,20"]  # fmt: skip
    (tmp_path / "plan.csv").write_text("\n".join(rows) + "\n")
    expected = programs(tmp_path, {"c": {"phases": [NS, EW]}})["c"]
    assert programs(tmp_path, {"c": {"file": "plan.csv"}})["c"] == expected
    (tmp_path / "plan.add.xml").write_text(f"<additional>\n{expected.to_xml('other')}</additional>")
    assert programs(tmp_path, {"c": {"file": "plan.add.xml"}})["c"] == expected


def test_actuated_phases_have_limits(crossing):
    phases = [NS | {"min_green_s": 8, "max_green_s": 45}, EW]
    program = programs(crossing, {"c": {"type": "actuated", "phases": phases}})["c"]
    assert program.type == "actuated"
    assert [(phase.min_s, phase.max_s) for phase in program.phases] == [
        (8, 45), (None, None), (None, None), (5, 20), (None, None), (None, None),
    ]  # fmt: skip


def test_sumo_shows_the_states_of_the_plan_each_second(crossing, tmp_path):
    """With offset 7 and a cycle of 60 s, second t of SUMO is second (t - 7) mod 60 of the plan."""
    setup = scenario(crossing, {"c": {"phases": [NS, EW], "offset_s": 7}})
    program = programs(crossing, {"c": {"phases": [NS, EW], "offset_s": 7}})["c"]
    expected = [phase.state for phase in program.phases for _ in range(round(phase.duration_s))]
    prepared = sumo_folder.prepare_simulation(setup, tmp_path / "sumo")
    assert prepared.roads.cycle_s == 60
    with sumo.serve_traci(["-c", sumo_folder.CONFIG_FILE, "--step-length", "1"], prepared.folder) as connection:
        for second in range(130):
            connection.simulationStep()
            assert connection.trafficlight.getRedYellowGreenState("c") == expected[(second - 7) % 60], second


@pytest.mark.slow
def test_summary_names_the_plan(crossing, tmp_path):
    summary = run_stage(traffic, scenario(crossing, {"c": {"phases": [NS, EW]}}), tmp_path / "own")
    (plan,) = summary["signals"]
    assert (plan["source"], plan["cycle_s"], plan["type"]) == ("from the scenario", 60, "fixed")
    rows = {(row["approach"], *row["movements"]): row for row in plan["rows"]}
    north = rows["Mill Lane (north)", "straight"]
    assert (north["green_s"], north["yellow_s"], north["gives_way"]) == ([[0, 30]], [[30, 33]], False)
    east = rows["High Street (east)", "left", "right"]
    assert (east["green_s"], east["gives_way"]) == ([[35, 55]], True)
    text = signal_descriptions.format_plan(plan)
    assert text == (
        "Signals at High Street / Mill Lane (from the scenario): fixed, cycle 60 s; green 30 s Mill Lane (north) and"
        " Mill Lane (south); 20 s High Street (east) and High Street (west)."
    )


def test_movements_with_equal_green_share_an_entry():
    """Left turns have 10 s of their own; straight on and right have green together, one of them giving way."""
    row = {"approach": "Mill Lane (north)", "yellow_s": [], "gives_way": False}
    rows = [
        row | {"movements": ["left"], "green_s": [[0, 10]]},
        row | {"movements": ["straight"], "green_s": [[10, 40]]},
        row | {"movements": ["right"], "green_s": [[10, 40]], "gives_way": True},
    ]
    plan = {"signal": "c", "streets": ["Mill Lane"], "source": "assumed", "type": "fixed", "cycle_s": 60, "rows": rows}
    assert signal_descriptions.format_plan(plan) == (
        "Signals at Mill Lane (assumed): fixed, cycle 60 s; green 10 s Mill Lane (north) left;"
        " 30 s Mill Lane (north) straight, right."
    )


def test_actuated_greens_are_at_most_the_longest():
    """netconvert writes a duration of 82 s beside a limit of 50 s: no green is longer than the cycle."""
    link = signals.Link(0, "north", "straight", "a", "", np.array([0.0, -1.0]))
    phases = (signals.Phase(82.0, "G", 5.0, 50.0), signals.Phase(3.0, "y"), signals.Phase(5.0, "r"))
    program = signals.Program("actuated", 0.0, phases)
    signal = signals.Signal("c", ("c",), (0.0, 0.0), (link,), program)
    region = Roi((-1.0, -1.0, 0.0), (2.0, 2.0, 1.0))
    (plan,) = signal_descriptions.describe_signals([signal], region, {}, "assumed")
    assert signal_descriptions.format_plan(plan) == (
        "Signals at c (assumed): actuated, cycle up to 58 s; green up to 50 s north."
    )
    (fixed,) = signal_descriptions.describe_signals(
        [replace(signal, program=replace(program, type="static"))], region, {}, "assumed"
    )
    assert signal_descriptions.format_plan(fixed) == "Signals at c (assumed): fixed, cycle 90 s; green 82 s north."


def test_plan_of_the_network_is_described_only_in_the_region(crossing):
    found = signals.read_signals(crossing / "net.net.xml", network.read_net_xml(crossing / "net.net.xml"))
    here, elsewhere = (
        signal_descriptions.describe_signals(found, Roi((x, -30.0, 0.0), (60.0, 60.0, 5.0)), {}, "assumed")
        for x in (-30.0, 100.0)
    )
    assert [plan["source"] for plan in here] == ["assumed"]
    assert elsewhere == []


@pytest.mark.slow
def test_signal_of_several_junctions_knows_its_foes(tmp_path):
    """One program for two junctions: positions in the states differ from those of each junction's requests."""
    netgenerate(tmp_path, "--grid", "--grid.x-number", "2", "--grid.y-number", "1", "--grid.length", "60",
                "--grid.attach-length", "100", "--default-junction-type", "traffic_light", "--no-turnarounds",
                "--tls.join", "--tls.join-dist", "100", name="net.net.xml")  # fmt: skip
    (signal,) = signals.read_signals(tmp_path / "net.net.xml", network.read_net_xml(tmp_path / "net.net.xml"))
    assert len(signal.nodes) == 2
    for link in signal.links:
        assert link.index not in link.foes
        assert all(link.index in signal.links[foe].foes for foe in link.foes)
    # in the program that netconvert made, no two foes have green with right of way
    for phase in signal.program.phases:
        green = {link.index for link in signal.links if phase.state[link.index] == "G"}
        assert not any(link.foes & green for link in signal.links if link.index in green)


def test_approach_may_stay_red(crossing, tmp_path):
    """Named without movements, in the scenario or in a table; a phase without any is red for all vehicles."""
    closed = {
        "phases": [NS | {"green": {"north": ["all"], "south": ["all"], "east": [], "west": []}}, EW | {"green": {}}]
    }
    (program,) = programs(crossing, {"c": closed}).values()
    shutil.copy(crossing / "net.net.xml", tmp_path)
    rows = "phase,approach,movement,green_s\na,north,all,30\na,south,all,30\na,east,,30\na,west,,30\nb,,,20\n"
    (tmp_path / "p.csv").write_text(rows)
    (from_table,) = programs(tmp_path, {"c": {"file": "p.csv"}}).values()
    assert from_table == program
    (signal,) = signals.read_signals(crossing / "net.net.xml", network.read_net_xml(crossing / "net.net.xml"))
    closed_links = {
        link.index for link in signal.links if link.side in ("east", "west") and link.movement != "crosswalk"
    }
    for phase in program.phases:
        assert all(phase.state[index] == "r" for index in closed_links)
    vehicles = [link.index for link in signal.links if link.movement != "crosswalk"]
    assert {program.phases[3].state[index] for index in vehicles} == {"r"}
    assert {letter for index, letter in enumerate(program.phases[3].state) if index not in vehicles} == {"G"}


WRONG = [
    ({"x": {"phases": [NS, EW]}}, r"traffic.signals.x: the network has no such signal. Its signals are: High Street"),
    ({"c": {"phases": [NS, EW | {"green": {"nrth": ["all"]}}]}},
     r"Lane \(c\) has no approach 'nrth'. Its approaches are: Mill Lane \(north\) \(right, straight, left"),
    ({"c": {"phases": [NS, EW | {"green": {"Mill Lane": ["all"]}}]}},
     r"approach 'Mill Lane' may be 'Mill Lane \(north\)' or 'Mill Lane \(south\)'. Use the full name"),
    ({"c": {"phases": [NS | {"green": {"north": ["sideways"]}}, EW]}},
     r"approach 'north' has no movement 'sideways'. Its approaches are: Mill Lane \(north\) \(right, straight, left"),
    ({"c": {"phases": [NS | {"green": {"north": ["straight"], "east": ["straight"]}}]}},
     r"phase 1: Mill Lane \(north\) straight and High Street \(east\) straight conflict, but both have green"),
    ({"c": {"phases": [NS | {"green": {"north": ["left"], "east": ["straight"]}}]}}, "conflict, but both have green"),
    ({"c": {"phases": [NS | {"green": {"north": ["straight", "crossing"]}}]}},
     r"Mill Lane \(north\) straight and Mill Lane \(north\) crosswalk conflict"),
    ({"c": {"phases": [NS]}}, r"never green: High Street \(east\) right, High Street \(east\) straight.*\. "
     r"Add these movements to a phase, or name their approach without movements if it stays red\."),
    ({"c": {"phases": [NS, EW], "cycle_s": 90}},
     r"cycle_s = 90: the phases with yellow and all-red add up to 60 s \(30, 3, 2, 20, 3, 2\). Use cycle_s = 60"),
    ({"c": {"phases": [NS, EW]}, "Mill Lane": {"phases": [NS, EW]}}, r"High Street / Mill Lane \(c\) has two plans"),
    ({"c": {"file": "missing.csv"}}, "missing.csv"),
]  # fmt: skip


@pytest.mark.parametrize(("plans", "message"), WRONG)
def test_rejects_plans_that_do_not_fit(crossing, plans, message):
    with pytest.raises(InputError, match=message):
        programs(crossing, plans)


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        ({}, "expected either phases or file, got none"),
        ({"phases": [NS], "file": "a.csv"}, "got both"),
        ({"phases": [NS], "type": "actuated", "cycle_s": 60}, "cycle_s has no effect with actuated"),
        ({"phases": [NS | {"max_green_s": 40}]}, 'max_green_s has no effect with a fixed plan. Set type = "actuated"'),
        ({"phases": [NS | {"min_green_s": 40}], "type": "actuated"}, "expected min_green_s up to max_green_s"),
        ({"file": "a.add.xml", "yellow_s": 4}, "yellow_s has no effect with a <tlLogic> file"),
    ],
)
def test_rejects_contradictory_keys(plan, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        TrafficConfig.from_dict({"network": "net.net.xml", "signals": {"c": plan}})


CSV = "phase,approach,movement,green_s\na,north,all,30\na,south,all,30\nb,east,all,20\nb,west,all,20\n"


def test_german_table_gives_the_same_program(crossing, tmp_path):
    shutil.copy(crossing / "net.net.xml", tmp_path)
    (tmp_path / "plan.csv").write_text(CSV)
    rows = ["Phase;Zufahrt;Richtung;Grün", "a;mill ln. (Nord);links geradeaus rechts;30", "a;S;alle;30"]
    (tmp_path / "plan_de.csv").write_text("\n".join([*rows, "b;Ost;alle;20", "b;HIGH-STREET (W);alle;20"]) + "\n")
    expected, german = (programs(tmp_path, {"c": {"file": name}})["c"] for name in ("plan.csv", "plan_de.csv"))
    assert german == expected


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("p.csv", "phase,approach\na,north\n", "the column 'movement' is missing"),
        ("p.csv", "", "expected a header and rows, got no values"),
        ("p.csv", CSV.replace("a,south,all,30", "a,south,all,25"),
         "line 3: green_s: expected 30 as before in phase 'a', got 25"),
        ("p.csv", CSV.replace("b,east,all,20", "b,east,all,often"), "line 4: green_s: expected seconds, got 'often'"),
        ("p.csv", CSV.replace("b,east,all,20", "b,east,all"), "line 4: expected 4 values, got 3"),
        ("p.csv", CSV.replace("green_s", "green_s,colour").replace("0\n", "0,red\n"), "unknown column 'colour'"),
        ("p.csv", CSV.replace("movement", "turns").replace("approach", "Ort"), "unknown columns 'Ort', 'turns'"),
        *(
            ("p.add.xml", f'<additional><tlLogic id="c"><phase duration="{text}" state="GG"/></tlLogic></additional>',
             f"invalid <tlLogic> (ValueError(\"duration = '{text}': expected seconds, from 0.001 to 1e+09\"))")
            for text in ("nan", "-0", "-5", "3e-06", "9223372036854775807")
        ),
        ("p.add.xml", '<additional><tlLogic id="c" type="0"><phase duration="9" state="GG"/></tlLogic></additional>',
         "invalid <tlLogic> (ValueError(\"type = '0': expected one of static, actuated, "),
        ("p.add.xml",
         '<additional><tlLogic id="c" offset="9e18"><phase duration="9" state="GG"/></tlLogic></additional>',
         "invalid <tlLogic> (ValueError('offset = 9e+18: expected seconds, at most 1e+09'))"),
        ("p.add.xml", "<additional/>", "no <tlLogic> with phases for the signal High Street / Mill Lane (c)"),
        ("p.add.xml", '<additional><tlLogic id="c"><phase duration="9" state="GG"/></tlLogic></additional>',
         "expected a state of 20 letters, got 2"),
        ("p.add.xml", f'<additional><tlLogic id="c"><phase duration="9" state="{"G" * 20}"/></tlLogic></additional>',
         "conflict, but both have green with right of way (G)"),
        ("p.add.xml", f'<additional><tlLogic id="c"><phase duration="9" state="{"r" * 20}"/></tlLogic></additional>',
         "never green"),
        ("p.add.xml", '<additional><tlLogic id="c"><phase state="r"/></tlLogic></additional>', "invalid <tlLogic>"),
    ],
)  # fmt: skip
def test_rejects_files_that_are_no_plan(crossing, tmp_path, name, content, message):
    shutil.copy(crossing / "net.net.xml", tmp_path)
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=re.escape(message)):
        programs(tmp_path, {"c": {"file": name}})


def test_check_reports_plans_before_the_simulation(crossing, tmp_path):
    shutil.copytree(crossing, tmp_path / "in")
    folder = tmp_path / "in"
    config = '<configuration><net-file value="net.net.xml"/><additional-files value="own.add.xml"/></configuration>'
    (folder / "own.sumocfg").write_text(config)
    (folder / "own.add.xml").write_text('<additional><tlLogic id="c" type="static" programID="x"/></additional>')
    setup = scenario(folder, {"c": {"phases": [NS, EW]}})
    values = setup.model_dump(exclude_unset=True)
    values["traffic"] = {"sumocfg": "own.sumocfg", "frames": 40, "signals": {"c": {"phases": [NS, EW]}}}
    setup = scenario_from_dict(values, folder, str(folder / "scenario.toml"))
    with pytest.raises(InputError, match=r"own\.add\.xml of the SUMO configuration also contains signal programs"):
        sumo_folder.prepare_simulation(setup, tmp_path / "sumo")


def test_plan_is_no_change_of_a_file_in_use(crossing, tmp_path):
    """The copy of the network is read to find the signal, and written again: SUMO's input is hashed after that."""
    setup = scenario(crossing, {"c": {"phases": [NS, EW]}})
    with use_digests(Digests(tmp_path)) as digests:
        sumo_folder.prepare_simulation(setup, tmp_path / "sumo")
        digests.check_unchanged()


def test_finished_traffic_has_no_plans(crossing):
    config = TrafficConfig.from_dict({"fcd": "a.csv", "signals": {"c": {"phases": [NS, EW]}}})
    assert [unused.keys for unused in config.unused_keys()] == [{"signals"}]


@pytest.mark.parametrize("word", ["back", "U-turn", "u turn", "U"])
def test_u_turn_has_one_printed_name(word):
    """A link of SUMO's direction "t" is found by each spelling, and printed as U-turn."""
    heading = np.array([0.0, -1.0])
    link = signals.Link(0, "north", directions.TURNS["t"], "a", "", heading)
    program = signals.Program("static", 0.0, (signals.Phase(20.0, "G"), signals.Phase(10.0, "r")))
    signal = signals.Signal("c", ("c",), (0.0, 0.0), (link,), program)
    phase = SignalPhaseConfig.from_dict({"green": {"north": [word]}, "green_s": 20})
    assert signal_plans._green_links(phase, signal, "plan") == {0}
    (plan,) = signal_descriptions.describe_signals([signal], Roi((-1.0, -1.0, 0.0), (2.0, 2.0, 1.0)), {}, "assumed")
    assert [row["movements"] for row in plan["rows"]] == [["U-turn"]]


def test_approach_is_known_by_the_name_of_another_street_to_it():
    links = [
        signals.Link(0, "High Street (west)", "straight", "a", "High Street", np.array([1.0, 0.0]), side="west",
                     aliases=("Back Lane",)),
        signals.Link(1, "Back Lane (north)", "left", "b", "Back Lane", np.array([0.0, -1.0]), side="north"),
    ]  # fmt: skip
    signal = signals.Signal("c", ("c",), (0.0, 0.0), tuple(links), signals.Program("static", 0.0, ()))
    for name, approach in (
        ("back ln. (west)", "High Street (west)"),
        ("Back Lane", "Back Lane (north)"),
        ("W", "High"),
    ):
        phase = SignalPhaseConfig.from_dict({"green": {name: ["all"]}, "green_s": 20})
        (index,) = signal_plans._green_links(phase, signal, "plan")
        assert links[index].approach.startswith(approach)


def test_straight_on_is_the_turn_that_stays_on_the_street():
    """Ring Road turns left at the signal; Mill Lane turns right off it."""
    ways = (("left", "Ring Road"), ("right", "Mill Lane"))
    north = np.array([0.0, -1.0])
    links = tuple(
        signals.Link(i, "Ring Road (north)", turn, "a", "Ring Road", north, side="north", target=out, way_out=out)
        for i, (turn, out) in enumerate(ways)
    )
    signal = signals.Signal("s", ("s",), (0.0, 0.0), links, signals.Program("static", 0.0, ()))

    def greens(movement):
        plan = SignalConfig(type="fixed", phases=[{"green": {"north": movement}, "green_s": 20}])
        return [phase.state for phase in signal_plans.make_program(plan, signal, "x").phases]

    assert greens(["straight", "right"]) == greens(["left", "right"])
    with pytest.raises(InputError, match=r"never green: Ring Road \(north\) right"):
        greens(["straight"])


def test_long_ids_are_shortened_and_still_accepted(tmp_path):
    """SUMO's id of joined nodes is cut after 19 characters in messages; both spellings find the signal."""
    name = "cluster_1423165998_1698047149_31384678"
    link = signals.Link(0, "Mill Lane (north)", "straight", "a", "Mill Lane", np.array([0.0, -1.0]))
    program = signals.Program("static", 0.0, ())
    long, other = (
        signals.Signal(each, (each,), (0.0, 0.0), (replace(link, street=street),), program)
        for each, street in ((name, "Mill Lane"), ("J2", "High Street"))
    )
    assert long.title == "Mill Lane (cluster_1423165998_…)"
    for spelling in (name, "cluster_1423165998_…", "mill ln"):
        assert signal_plans.find_signal(spelling, [long, other], "x") is long
    with pytest.raises(InputError, match=r"Its signals are: Mill Lane \(cluster_1423165998_…\), High Street \(J2\)\."):
        signal_plans.find_signal("Oak Street", [long, other], "x")
    twin = replace(long, id=f"{name}_2", nodes=(f"{name}_2",))
    with pytest.raises(InputError, match=rf"2 signals have this name: Mill Lane \({name}\), Mill Lane \({name}_2\)"):
        signal_plans.find_signal("cluster_1423165998_…", [long, twin], "x")


@pytest.mark.slow
@pytest.mark.parametrize("signalised", [True, False])
def test_network_without_internal_links_is_rejected(crossing, tmp_path, signalised):
    """Vehicles would jump across the junction, and signals cannot be read; the message says how to make it again."""
    signals_of_it = [] if signalised else ["--tls.discard-loaded"]
    sumo.run_netconvert(
        ["-s", str(crossing / "net.net.xml"), "--no-internal-links", *signals_of_it], tmp_path, "net.net.xml"
    )
    roads = network.read_net_xml(tmp_path / "net.net.xml")
    assert roads.lacks_internal_edges
    assert not network.read_net_xml(crossing / "net.net.xml").lacks_internal_edges
    command = r"netconvert -s net\.net\.xml --no-internal-links false -o new\.net"
    message = rf"net\.net\.xml: the network has no edges inside its junctions .* {command}"
    if signalised:
        with pytest.raises(InputError, match=message):
            signals.read_signals(tmp_path / "net.net.xml", roads)
    with pytest.raises(InputError, match=message):
        sumo_network.read_roads(tmp_path / "net.net.xml", RoadOptions())
    report = check.check_scenario(scenario(tmp_path, {}))
    (error,) = [finding for finding in report.errors if finding.rule == "traffic"]
    assert re.search(message, str(error))

    sumo.run_netconvert(["-s", "net.net.xml", "--no-internal-links", "false"], tmp_path, "new.net.xml")
    assert not network.read_net_xml(tmp_path / "new.net.xml").lacks_internal_edges


PLANNED = """
[roi]
center_m = [0, 0, 2.5]
size_m = [60, 60, 5]
voxel_m = 1.0
[traffic]
network = "net.net.xml"
vehicles = 6
frames = 40
warmup_s = 20.0
{plan}
[sites]
file = "sites.csv"
sensor = "VLP-16"
"""


@needs("hardware")
@pytest.mark.slow
@pytest.mark.parametrize("plan", [
    'signals.c.phases = [{ green = { north = ["all"], south = ["all"] }, green_s = 30 }, '
    '{ green = { east = ["all"], west = ["all"] }, green_s = 20 }]',
    'signals.c.file = "own.add.xml"',
])  # fmt: skip
def test_every_command_reads_a_run_with_plans(crossing, tmp_path, monkeypatch, run_egvs, plan):
    """Its record has all defaults, e.g. of the limits of actuated phases."""
    folder = shutil.copytree(crossing, tmp_path / "in")
    (folder / "scenario.toml").write_text(PLANNED.format(plan=plan))
    (folder / "sites.csv").write_text("site,x_m,y_m,z_m\na,12,12,5\nb,-12,-12,5\n")
    net = (folder / "net.net.xml").read_text()
    program = net[net.index("<tlLogic") : net.index("</tlLogic>") + len("</tlLogic>")]
    (folder / "own.add.xml").write_text(f"<additional>{program}</additional>")
    monkeypatch.chdir(tmp_path)
    design = ("--pole", "a", "--sensors", "VLP-16", "--evaluations", "20", "--heights", "4,5")
    for command in (
        ("run", "in", "--out", "out"), ("place", "out", "--count", "2"), ("export", "out", "--to", "csv"),
        ("figure", "out", "--what", "tpog", "--format", "svg"), ("sheets", "out", "--format", "svg"), ("report", "out"),
        ("sensor", "design", "out", *design), ("verify", "out"),
    ):  # fmt: skip
        code, _, err = run_egvs(*command)
        assert code == 0, (command, err)
