"""Signals of a map: one for each junction on the ground, with a plan that serves all of its movements."""

import re
import shutil
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from egvs.core.errors import InputError
from egvs.creation import junctions
from egvs.creation.junction_zones import junction_zones
from egvs.creation.openstreetmap import street_network
from egvs.creation.openstreetmap.street_network import StreetNetwork
from egvs.creation.openstreetmap.street_signals import number_crossings
from egvs.formats import osm
from egvs.scenario.loading import load
from egvs.scenario.signal_config import SignalConfig
from egvs.traffic import signals
from egvs.traffic.approaches import ApproachIndex
from egvs.traffic.assumed_plans import CYCLE_S
from egvs.traffic.movements import MovementNames
from egvs.traffic.network import read_net_xml
from egvs.traffic.signal_descriptions import describe_simulated
from egvs.traffic.signal_plans import agree, apply_plans, make_program
from egvs.traffic.signals import Signal
from tests.creation.new_scenarios import create_scenario
from tests.creation.small_maps import XY, street, write_map

pytestmark = pytest.mark.system

REAL = Path(__file__).parents[3] / "shared" / "real"
SIGNAL = {"highway": "traffic_signals"}
CROSSWALK = {"highway": "crossing", "crossing": "traffic_signals"}

WIDE_M = 36.0


def nodes(gap_m: float = WIDE_M) -> dict[int, XY]:
    """A main road of two carriageways crosses a side street; a minor street joins it from the north."""
    return {
        1: (-200, 0), 2: (-25, 0), 3: (0, 0), 4: (200, 0),
        5: (200, gap_m), 6: (20, gap_m), 7: (0, gap_m), 8: (-200, gap_m),
        9: (0, -200), 10: (0, -18), 11: (0, gap_m + 20), 12: (0, 250),
        13: (120, 0), 14: (120, gap_m), 15: (-100, gap_m), 16: (-100, 200), 17: (-85, gap_m),
    }  # fmt: skip


WAYS = [
    street("Ring", 1, 2, 3, 13, 4, road_class="primary", oneway="yes", lanes="2"),
    street("Ring", 5, 14, 6, 7, 15, 8, road_class="primary", oneway="yes", lanes="2"),
    street("Gate", 9, 10, 3, 7, 11, 12, road_class="secondary", lanes="2"),
    street("Yard", 15, 16),
]
OUTER = {"Gate (north)", "Gate (south)", "Ring (west)", "Ring (east)"}
AT_STOP_LINES = {2: SIGNAL, 6: SIGNAL, 10: SIGNAL | {"crossing": "traffic_signals"}, 11: CROSSWALK}


def build(
    folder: Path, tags: dict[int, dict[str, str]], *, walk: bool = False, gap_m: float = WIDE_M, two_way: bool = False
) -> StreetNetwork:
    ways = [*WAYS]
    if two_way:
        ways[1] = street("Ring", 5, 14, 6, 7, 17, 15, 8, road_class="primary", lanes="2")
    path = write_map(folder / "map.osm", nodes(gap_m), ways, tags)
    extract = osm.read_osm(path)
    return street_network.build_network(
        extract, path, street_network.netconvert_flags(extract, lefthand=False, walk=walk)
    )


def read_signals(folder: Path, made: StreetNetwork) -> list[Signal]:
    (folder / "network.net.xml").write_text(made.text, encoding="utf-8")
    return list(signals.read_signals(folder / "network.net.xml", made.streets.network))


def check_program(signal: Signal) -> None:
    """Check that all vehicles get green, that no two greens conflict, and that nobody waits longer than a cycle."""
    greens = [{i for i, letter in enumerate(phase.state) if letter in "Gg"} for phase in signal.program.phases]
    for green in greens:
        assert all(agree(a, b) for a, b in combinations([link for link in signal.links if link.index in green], 2))
    assert set().union(*greens) == {link.index for link in signal.links}
    assert sum(phase.max_s or phase.duration_s for phase in signal.program.phases) <= CYCLE_S


@pytest.mark.slow
@pytest.mark.parametrize(("walk", "gap_m", "number"), [(False, 24.0, 1), (False, WIDE_M, 2), (True, WIDE_M, 2)])
def test_signals_at_stop_lines_become_one_signal(tmp_path: Path, walk: bool, gap_m: float, number: int) -> None:
    made = build(tmp_path, AT_STOP_LINES, walk=walk, gap_m=gap_m)
    (signal,) = read_signals(tmp_path, made)
    assert len(signal.nodes) == number
    assert {link.approach for link in signal.links if link.side} == OUTER
    check_program(signal)
    (junction,) = [each for each in made.streets.junctions if each.signalised]
    assert (junction.nodes, junction.arms, junction.lanes_in) == (signal.nodes, 4, 6)
    flows = junctions.assumed_flows(made.streets, junctions.region_around(junction))
    names = MovementNames(made.streets.network, junction.at_m, flows)
    assert set(ApproachIndex.of_flows(flows, names).titles) == OUTER
    assert {zone.name for zone in junction_zones(made.streets, junction, junctions.region_around(junction))} >= {
        f"{name} stop line" for name in OUTER
    }
    together = [
        {link.approach for link in signal.links if phase.state[link.index] in "Gg" and link.movement == "straight"}
        for phase in signal.program.phases
    ]
    assert any({"Ring (west)", "Ring (east)"} <= approaches for approaches in together)
    assert any({"Gate (north)", "Gate (south)"} <= approaches for approaches in together)


@pytest.mark.slow
def test_plan_states_the_outer_approaches(tmp_path: Path) -> None:
    """The street between the carriageways has green with the movements that lead to it."""
    (signal,) = read_signals(tmp_path, build(tmp_path, AT_STOP_LINES))
    inner = {link.index for link in signal.links if link.edge in {each.target for each in signal.links}}
    plan = SignalConfig.from_dict(
        {
            "phases": [
                {"green": {"Ring (west)": ["all"], "Ring (east)": ["all"]}, "green_s": 30},
                {"green": {"Gate (north)": ["all"], "Gate (south)": ["all"]}, "green_s": 20},
            ]
        }
    )
    program = make_program(plan, signal, "plan")
    assert inner
    assert all(program.phases[3].state[index] in "Gg" for index in inner)


@pytest.mark.slow
@pytest.mark.parametrize(("walk", "number"), [(False, 0), (True, 1)])
def test_signal_of_a_crossing_stays_where_people_walk(tmp_path: Path, walk: bool, number: int) -> None:
    found = read_signals(tmp_path, build(tmp_path, {13: CROSSWALK | SIGNAL}, walk=walk))
    assert len(found) == number
    for signal in found:
        assert {phase.state[0] for phase in signal.program.phases} == {"G", "y", "r"}
        check_program(signal)


def test_signal_on_one_of_three_approaches_leaves_junction_uncontrolled(tmp_path: Path) -> None:
    assert not read_signals(tmp_path, build(tmp_path, {17: CROSSWALK}, two_way=True))


@pytest.mark.slow
def test_node_inside_a_junction_without_signal_is_named(tmp_path: Path) -> None:
    """The map lacks the signal of the southern carriageway."""
    made = build(tmp_path, {6: SIGNAL, 10: SIGNAL, 11: SIGNAL})
    (signal,) = read_signals(tmp_path, made)
    assert len(signal.nodes) == 1
    (note,) = [note for note in made.notes if "inside" in note]
    assert re.match(r"1 node inside signalised junctions has no signal.*: Gate / Ring at 52\.0", note)


def test_crossings_keep_positions_of_their_own() -> None:
    line = '    <connection from="{}" to="{}" fromLane="0" toLane="0" tl="{}" linkIndex="{}" dir="s" state="M"/>\n'
    rows = [("a", "b", "s", 0), ("c", "d", "s", 1), (":x_w0", ":x_c0", "s", 1), (":y_w0", ":y_c0", "s", 1)]
    rows += [("e", "f", "t", 0), (":z_w0", ":z_c0", "t", 1)]
    text = number_crossings("".join(line.format(*row) for row in rows))
    assert re.findall(r'linkIndex="(\d+)"', text) == ["0", "1", "2", "3", "0", "1"]


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="real maps are not beside the checkout (shared/real)")
@pytest.mark.parametrize(
    ("name", "at", "lanes_in", "number"),
    [
        ("osnabrueck.osm.gz", (52.2724, 8.0405), 9, 3),
        ("bad_hersfeld.osm", (50.8701, 9.7126), 8, 3),
        ("bad_hersfeld_east.osm.gz", (50.86219, 9.71990), 6, 9),
        ("berlin_neukoelln.osm.gz", (52.47375, 13.44058), 5, 1),
    ],
)
def test_real_junctions_have_one_signal(
    tmp_path: Path, name: str, at: tuple[float, float], lanes_in: int, number: int
) -> None:
    extract = osm.read_osm(REAL / name)
    flags = street_network.netconvert_flags(extract, lefthand=False, walk=False)
    made = street_network.build_network(extract, REAL / name, flags)
    found = read_signals(tmp_path, made)
    assert len(found) == number
    for signal in found:
        check_program(signal)
    ((x_m, y_m),) = made.streets.to_xy([at[1]], [at[0]])
    (here,) = [signal for signal in found if abs(signal.at_m[0] - x_m) < 40 and abs(signal.at_m[1] - y_m) < 40]
    targets = {link.target for link in here.links}
    outer = {link.edge for link in here.links} - targets
    lanes = {edge.id: edge.lanes_for("passenger") for edge in made.streets.network.edges}
    assert sum(lanes[edge] for edge in outer) == lanes_in


@pytest.fixture(scope="module")
def made_scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("new")
    write_map(folder / "map.osm", nodes(), WAYS, AT_STOP_LINES)
    create_scenario(folder / "made", folder / "map.osm", righthand=True)
    return folder / "made"


@pytest.mark.slow
def test_untouched_tables_change_nothing(made_scenario: Path, tmp_path: Path) -> None:
    """The counts are those that were assumed, and the plan is that of the network."""
    scenario = load(made_scenario)
    (signal,) = scenario.traffic.signals
    assert signal.startswith("signal_")
    network = made_scenario / "network.net.xml"
    shutil.copy(network, tmp_path)
    apply_plans(scenario, tmp_path / network.name, network)
    assert (tmp_path / network.name).read_text() == network.read_text()
    (plan,) = describe_simulated(scenario, signals.read_signals(network, read_net_xml(network)))
    assert plan["source"] == "assumed"
    assert all(count.per_hour == round(count.per_hour) > 0 for count in scenario.traffic.counts)
    assert any("traffic" in entry for entry in scenario.assumed)


@pytest.mark.slow
def test_edited_tables_are_used_and_stay(made_scenario: Path, tmp_path: Path, run_egvs: Any) -> None:
    shutil.copytree(made_scenario, tmp_path / "made")
    counts, signals_table = tmp_path / "made" / "counts.csv", tmp_path / "made" / "signals.csv"
    header, first, *rest = counts.read_text().splitlines()
    edited = ";".join([*first.split(",")[:-1], "1234,5"])
    counts.write_text("\n".join([header.replace(",", ";"), edited, *(row.replace(",", ";") for row in rest)]) + "\n")
    signals_table.write_text(re.sub(r",\d+$", ",17", signals_table.read_text(), flags=re.MULTILINE))
    scenario = load(tmp_path / "made")
    _, checked, _ = run_egvs("check", tmp_path / "made")
    assert re.search(r"Signals at .* \(signals\.csv\): actuated, cycle up to 44 s; green up to 17 s ", checked)
    assert scenario.traffic.counts[0].per_hour == 1234.5
    assert scenario.traffic.counts[1:] == load(made_scenario).traffic.counts[1:]
    network = tmp_path / "made" / "network.net.xml"
    apply_plans(scenario, network, network)
    (plan,) = describe_simulated(scenario, signals.read_signals(network, read_net_xml(network)))
    assert (plan["source"], plan["cycle_s"]) == ("signals.csv", 2 * (17 + 5))
    with pytest.raises(InputError, match="not empty"):
        create_scenario(tmp_path / "made", tmp_path / "map.osm", righthand=True)
    assert "1234,5" in counts.read_text()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("approach,turn,count\nRing (west),left,5\n", "line 2: expected from_edge and to_edge, or edge, got neither"),
        ("from_edge,to_edge,count\na,b,many\n", "line 2: count: expected vehicles per hour, got 'many'"),
        ("from_edge,to_edge\na,b\n", "the column 'count' is missing"),
        ("from_edge,to_edge,count,colour\na,b,3,red\n", "unknown column 'colour'"),
        ("from_edge,to_edge,Anzahl,colour,age\na,b,3,red,1\n", "unknown columns 'colour', 'age'"),
        (None, "traffic.counts: no such file"),
    ],
)
def test_rejects_tables_of_counts(made_scenario: Path, tmp_path: Path, content: str | None, message: str) -> None:
    shutil.copytree(made_scenario, tmp_path / "made")
    table = tmp_path / "made" / "counts.csv"
    table.unlink()
    if content is not None:
        table.write_text(content)
    with pytest.raises(InputError, match=message):
        load(tmp_path / "made")
