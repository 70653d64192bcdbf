"""Scenarios that extend others: which keys replace which."""

from __future__ import annotations

from pathlib import Path

import pytest

import egvs
from egvs.core.errors import InputError
from egvs.scenario import loading
from egvs.scenario.model import Scenario

BASE = """
[roi]
center_m = [0, 0, 2.5]
size_m = [40, 20, 5]

[traffic]
network = "a.net.xml"
routes = ["a.rou.xml"]
vehicles = 30
warmup_s = 60
frame_period_s = 0.25

[[traffic.kinds]]
name = "car"
length_m = 4.5
width_m = 1.8
height_m = 1.5

[sites]
file = "sites.csv"
points = "measured.ply"
pitch_deg = -5
"""

DRAWN = BASE.replace('routes = ["a.rou.xml"]\n', "")
GRID = "[sites.grid]\nlow_m = [0, 0]\nhigh_m = [9, 0]\nspacing_m = 3\nheights_m = [4]\n"


def extended(tmp_path: Path, above: str, below: str = DRAWN, *overrides: str) -> Scenario:
    for name, text in (("below", below), ("above", 'extends = "../below"\n' + above)):
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "scenario.toml").write_text(text)
    return egvs.load(tmp_path / "above", overrides)


def test_rule_replaces_site_file_and_measured_scan(tmp_path: Path) -> None:
    sites = extended(tmp_path, GRID).sites
    assert (sites.file, sites.points, sites.pitch_deg) == (None, None, -5)
    assert sites.grid is not None and sites.grid.spacing_m == 3
    back = extended(tmp_path, '[sites]\nfile = "other.csv"\n', DRAWN.split("[sites]")[0] + GRID).sites
    assert (back.file, back.grid) == ("other.csv", None)


def test_merges_table_of_same_source(tmp_path: Path) -> None:
    sites = extended(tmp_path, "[sites.grid]\nspacing_m = 1\n", DRAWN.split("[sites]")[0] + GRID).sites
    assert sites.grid is not None
    assert (sites.grid.spacing_m, sites.grid.high_m) == (1, (9, 0))
    traffic = extended(tmp_path, '[traffic]\nnetwork = "b.net.xml"\n').traffic
    assert (traffic.network, traffic.vehicles) == ("b.net.xml", 30)


def test_finished_file_replaces_network_and_its_keys(tmp_path: Path) -> None:
    traffic = extended(tmp_path, '[traffic]\nfcd = "fcd.csv"\n').traffic
    assert (traffic.network, traffic.fcd) == (None, "fcd.csv")
    assert (traffic.warmup_s, traffic.frames, traffic.frame_period_s) == (0, None, 1.0)
    assert "vehicles" not in traffic.model_fields_set
    assert [kind.name for kind in traffic.kinds] == ["car"]  # its sizes


@pytest.mark.parametrize("source", ["network", "sumocfg", "fcd"])
@pytest.mark.parametrize("old", ["network", "sumocfg", "fcd"])
def test_new_source_of_traffic_replaces_old(tmp_path: Path, old: str, source: str) -> None:
    below = f'[roi]\ncenter_m = [0, 0, 1]\nsize_m = [4, 4, 2]\n[sites]\nfile = "s.csv"\n[traffic]\n{old} = "old"\n'
    traffic = extended(tmp_path, f'[traffic]\n{source} = "new"\n', below).traffic
    assert {key: getattr(traffic, key) for key in ("network", "sumocfg", "fcd") if getattr(traffic, key)} == {
        source: "new"
    }


def test_routes_are_dropped_with_their_source(tmp_path: Path) -> None:
    below = BASE.split("[[traffic.kinds]]")[0] + "[sites]" + BASE.split("[sites]")[1]
    assert extended(tmp_path, '[traffic]\nsumocfg = "x.sumocfg"\n', below).traffic.routes == ()
    assert extended(tmp_path, '[traffic]\nnetwork = "b.net.xml"\n', below).traffic.routes == ("a.rou.xml",)


def test_override_replaces_source(tmp_path: Path) -> None:
    scenario = extended(tmp_path, "", DRAWN, "traffic.fcd=x.csv", "sites.file=y.csv")
    assert (scenario.traffic.network, scenario.traffic.fcd, scenario.sites.file) == (None, "x.csv", "y.csv")


def test_rejects_two_sources(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match="expected exactly one of network, sumocfg, fcd and tracks, got network and fcd"
    ):
        extended(tmp_path, '[traffic]\nfcd = "x.csv"\nnetwork = "b.net.xml"\n')
    with pytest.raises(InputError, match="vehicles has no effect with fcd"):
        extended(tmp_path, '[traffic]\nfcd = "x.csv"\nvehicles = 5\n')


@pytest.mark.parametrize("row", ["car", "0"])
def test_override_finds_row_by_name_or_number(mini: Path, row: str) -> None:
    scenario = egvs.load(mini, [f"traffic.kinds.{row}.length_m=6.5"])
    assert scenario.traffic.kinds[0].length_m == 6.5
    assert scenario.traffic.kinds[1:] == egvs.load(mini).traffic.kinds[1:]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["sites.yaw_deg=90", "sites.aim='roi'"],
            "--set: sites.yaw_deg: the key has no effect: the later --set sites.aim='roi' replaces it",
        ),
        (
            ["sites.sensor=OS1-128", "sites.replace_sensor=VLP-16"],
            "--set: sites.sensor: the key has no effect: the later --set sites.replace_sensor=VLP-16 replaces it",
        ),
        (
            ["traffic.frames=20", "traffic.network='net.net.xml'", "traffic.fcd='fcd.csv'"],
            "--set: traffic.frames: the key has no effect: the later --set traffic.fcd='fcd.csv' replaces it",
        ),
        (
            ["statics.polygon_height_m=4"],
            "--set: statics: polygon_height_m has no effect without polygons. Set polygons, or remove",
        ),
        (
            ["statics.polygon_types={building='ignore'}", "statics.polygon_height_m=4"],
            "--set: statics: polygon_height_m and polygon_types have no effect without polygons",
        ),
    ],
)
def test_rejects_override_without_effect(mini: Path, overrides: list[str], message: str) -> None:
    with pytest.raises(InputError) as error:
        egvs.load(mini, overrides)
    assert message in str(error.value)


@pytest.mark.parametrize("vclass", ["", "a bus", "Bus", "x" * 41])
def test_kind_with_a_wrong_class_is_the_only_problem(mini: Path, vclass: str) -> None:
    kind = f"{{name='car', vclass='{vclass}', length_m=4, width_m=2, height_m=1}}"
    with pytest.raises(InputError) as error:
        egvs.load(mini, [f"traffic.kinds=[{kind}]"])
    assert str(error.value) == (
        f"--set: traffic.kinds.0.vclass: expected a vClass of SUMO, such as passenger or bus, got {vclass!r}"
    )


def test_last_value_of_a_key_counts(mini: Path) -> None:
    scenario = egvs.load(mini, ["sites.yaw_deg=90", "sites.yaw_deg=45", "traffic.fcd='fcd.csv'", "traffic.frames=20"])
    assert (scenario.sites.yaw_deg, scenario.traffic.frames) == (45.0, 20)


def test_scenario_without_polygons_takes_over_no_keys_of_polygons(mini: Path) -> None:
    base = mini / "scenario.toml"
    base.write_text(base.read_text() + "\n[statics.polygon_types]\nbuilding = 3\n")
    base.write_text(base.read_text().replace("[statics]\n", "[statics]\npolygons = ['solids.poly.xml']\n"))
    (mini / "child").mkdir()
    (mini / "child" / "scenario.toml").write_text('extends = ".."\n[statics]\npolygons = []\n')
    assert egvs.load(mini).statics.polygon_types == {"building": 3.0}
    assert egvs.load(mini / "child").statics.polygon_types == {}


@pytest.mark.parametrize(
    ("text", "key", "choices"),
    [
        ("[placement]\nbudget = 30.000", "placement.budget: 30.000", "30 or 30000"),
        ('[costs]\nsensor = { "VLP-32C" = 8.000 }', "costs.sensor.VLP-32C: 8.000", "8 or 8000"),
        ("[costs]\nmetre = 12.345", "costs.metre: 12.345", "12.3450 or 12345"),
    ],
)
def test_costs_with_three_decimals_are_ambiguous(mini: Path, text: str, key: str, choices: str) -> None:
    file = mini / "scenario.toml"
    scenario = file.read_text()
    file.write_text(f"{scenario}\n{text}\n")
    with pytest.raises(InputError, match=f"scenario.toml: {key} can mean {choices}. Write {choices}."):
        loading.load(mini)
    file.write_text(f"{scenario}\n[costs]\nsensor = {{ VLP-32C = 8000 }}\nmetre = 12.3450\npole = 0.125\n")
    assert loading.load(mini, ["placement.budget=30.0"]).costs.metre == 12.345


def test_errors_name_the_command_line_for_keys_that_it_sets(mini: Path) -> None:
    scenario = loading.load(mini, ["placement.budget=30", "sites.file=poles.csv"])
    assert scenario.locate("placement.budget") == "command line: placement.budget"
    assert scenario.locate("placement.count") == f"{mini / 'scenario.toml'}: placement.count"
    with pytest.raises(InputError, match=r"^command line: sites.file = 'poles.csv': no such file"):
        scenario.find("poles.csv", "sites.file")


@pytest.mark.parametrize(
    ("key", "hint"),
    [
        ("existing_poles='all'", "existing_poles: unknown key. Did you mean sites.existing_poles?"),
        ("placement.existing_poles='all'", "placement.existing_poles: unknown key. Did you mean sites.existing_poles?"),
        ("sites.heights=[3]", "sites.heights: unknown key. Did you mean heights_m?"),
        ("placement.nothing_like_it=1", "placement.nothing_like_it: unknown key. Known keys are budget, count, "),
    ],
)
def test_names_the_table_of_a_key_that_stands_elsewhere(key: str, hint: str) -> None:
    with pytest.raises(InputError) as error:
        loading.load("demo", [key])
    assert hint in str(error.value)


@pytest.mark.parametrize("key", ["frame_period_s", "step_s"])
def test_times_below_a_millisecond_are_refused_before_frames_are_counted(key: str, tmp_path: Path) -> None:
    """``length_s`` of a period, divided by such a time, is infinite."""
    above = f'[traffic]\n{key} = 1e-320\n[[traffic.periods]]\nname = "day"\nlength_s = 60\n'
    with pytest.raises(InputError, match=rf"traffic\.{key}: expected a value greater than or equal to 0\.001"):
        extended(tmp_path, above)
