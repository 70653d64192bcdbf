"""The folder that SUMO runs in, and wrong inputs."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.scenario.loading import load
from egvs.stages import traffic
from egvs.traffic import demand, network
from tests.stage_runner import inputs_of, run_stage
from tests.traffic.helpers import car, drawn, scenario, scenario_with_config


def nothing(folder):
    """No change."""


def write(name, text):
    return lambda folder: (folder / name).write_text(text)


CAR_ROUTE = '<routes><vehicle id="v" depart="0"><route edges="nowhere"/></vehicle></routes>'


BOMB = '<!DOCTYPE net [<!ENTITY a "b">]><net>&a;</net>'


FCD = "timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type"


BAD = {
    "period between steps": (
        nothing,
        {"network": "net.xml", "frame_period_s": 0.3},
        InputError,
        r"traffic\.frame_period_s = 0\.3: expected a multiple of the step of 0\.25 s. Use 0\.25 or 0\.5",
    ),
    "warm-up between steps": (
        nothing,
        {"network": "net.xml", "warmup_s": 10.1},
        InputError,
        r"warmup_s = 10\.1: expected a multiple",
    ),
    "step between milliseconds": (
        nothing,
        {"network": "net.xml", "step_s": 0.0015},
        InputError,
        r"step_s = 0\.0015: expected a whole number of milliseconds",
    ),
    "no network": (
        nothing,
        {"network": "none.net.xml"},
        InputError,
        r"traffic\.network = 'none\.net\.xml': no such file",
    ),
    "a map in another format": (
        write("m.osm.pbf", "OSMHeader"),
        {"network": "m.osm.pbf"},
        InputError,
        r"m\.osm\.pbf: expected a SUMO network, got a map\. Run egvs new NAME --from m\.osm\.pbf",
    ),
    "no routes": (
        nothing,
        {"network": "net.xml", "routes": ["r.xml"]},
        InputError,
        r"traffic\.routes = 'r\.xml': no such file",
    ),
    "empty network": (write("e.xml", "<net/>"), {"network": "e.xml"}, InputError, r"e\.xml: the network has no roads"),
    "no network inside": (
        write("e.xml", "<routes/>"),
        {"network": "e.xml"},
        InputError,
        r"e\.xml: expected the root element <net>, got <routes>",
    ),
    "malformed network": (
        write("e.xml", "<net><edge"),
        {"network": "e.xml"},
        InputError,
        r"e\.xml: is not well-formed XML",
    ),
    "network with entities": (write("e.xml", BOMB), {"network": "e.xml"}, InputError, r"e\.xml: declares XML entities"),
    "damaged edge": (
        write("e.xml", '<net><edge id="a" from="b"/></net>'),
        {"network": "e.xml"},
        InputError,
        r"invalid <edge id='a'>",
    ),
    "kind unknown to SUMO": (
        nothing,
        {"network": "net.xml", "kinds": [car(vclass="saucer").model_dump()]},
        InputError,
        r"kind 'car' has the unknown vClass 'saucer'",
    ),
    "trips too long": (
        nothing,
        {"network": "net.xml", "min_trip_m": 5000},
        InputError,
        r"cannot make any trip of at least 5000 m",
    ),
    "routes off the network": (
        write("r.xml", CAR_ROUTE),
        {"network": "net.xml", "routes": ["r.xml"]},
        InputError,
        r"scenario\.toml: traffic: SUMO cannot run net\.xml, r\.xml: sumo ended with exit code 1:\n.*nowh",
    ),
    "configuration names no network": (
        write("c.sumocfg", "<configuration/>"),
        {"sumocfg": "c.sumocfg"},
        InputError,
        r"c\.sumocfg: has no net-file",
    ),
    "configuration names a blank network": (
        write("c.sumocfg", '<configuration><net-file value=" "/></configuration>'),
        {"sumocfg": "c.sumocfg"},
        InputError,
        r"c\.sumocfg: has no net-file",
    ),
    "configuration names two networks": (
        write("c.sumocfg", '<configuration><net-file value="net.xml, net.xml"/></configuration>'),
        {"sumocfg": "c.sumocfg"},
        InputError,
        r"c\.sumocfg: expected one net-file, got 2",
    ),
    "configuration names a missing file": (
        write("c.sumocfg", '<configuration><net-file value="gone.xml"/></configuration>'),
        {"sumocfg": "c.sumocfg"},
        InputError,
        r"c\.sumocfg: net-file = 'gone\.xml': no such file",
    ),
    "configuration makes vehicles jump": (
        write(
            "c.sumocfg", '<configuration><net-file value="net.xml"/><no-internal-links value="true"/></configuration>'
        ),
        {"sumocfg": "c.sumocfg"},
        InputError,
        r"no-internal-links = 'true': makes vehicles jump",
    ),
    "unknown type in a finished file": (
        write("f.csv", f"{FCD}\n0;v;1;2;3;tram\n1;v;1;2;3;tram\n"),
        {"fcd": "f.csv", "frames": 1, "warmup_s": 0, "frame_period_s": 1},
        InputError,
        r"the sizes of these vehicle types in f.csv are unknown: 'tram'",
    ),
    "too few frames in a finished file": (
        write("f.csv", f"{FCD}\n0;v;1;2;3;car\n1;v;1;2;3;car\n"),
        {"fcd": "f.csv", "frames": 9, "warmup_s": 0, "frame_period_s": 1},
        InputError,
        r"frames = 9: \S+ has 2 frames",
    ),
}


@pytest.mark.parametrize(("prepare", "keys", "error", "message"), BAD.values(), ids=BAD.keys())
def test_rejects_wrong_input(town, tmp_path, prepare, keys, error, message):
    shutil.copy(town / "net.xml", tmp_path)
    prepare(tmp_path)
    with pytest.raises(error, match=message):
        run_stage(traffic, scenario(tmp_path, **keys), tmp_path / "out")
    assert not (tmp_path / "out" / "trajectories.parquet").exists()


def test_rejects_traci_with_finished_file(tmp_path):
    (tmp_path / "f.csv").write_text("x")
    with pytest.raises(InputError, match="--traci: the traffic of the scenario was recorded before"):
        run_stage(traffic, scenario(tmp_path, fcd="f.csv"), tmp_path, traci=("localhost", 1))


def test_rejects_input_file_in_the_folder_for_sumo(town, tmp_path):
    user_file = tmp_path / "sumo" / "net.xml"
    user_file.parent.mkdir()
    shutil.copy(town / "net.xml", user_file)
    with pytest.raises(InputError, match=r"sumo/net\.xml: an input file is in a folder that egvs empties for SUMO"):
        run_stage(traffic, scenario(tmp_path, network="sumo/net.xml"), tmp_path)
    assert user_file.is_file()


@pytest.mark.slow
def test_removes_files_of_an_earlier_run(town, tmp_path):
    left = tmp_path / "sumo" / "fcd.csv"
    left.parent.mkdir()
    left.write_text("another run's")
    keys = {"network": "net.xml", "frames": 2, "warmup_s": 0.0, "vehicles": 1, "hold": "at_most"}
    with left.open("a") as still_written:
        run_stage(traffic, scenario(town, **keys), tmp_path)
        still_written.write("more")
    assert not left.exists() and (tmp_path / "trajectories.parquet").is_file()


USER_CONFIG = """<configuration>
  <input><net-file value="net.xml"/><route-files value="own.rou.xml"/></input>
</configuration>
"""


FIVE_FRAMES = {"frames": 5, "warmup_s": 5.0, "frame_period_s": 0.25}


@pytest.fixture
def crowded_folder(town, tmp_path):
    """A user's configuration: sixty cars that are all under way from the first second on."""
    roads = network.read_net_xml(town / "net.xml")
    pairs = demand.origin_destination_pairs(roads, car(), drawn(min_trip_m=200), np.random.default_rng(0), "place")
    ends = [(roads.edges[o].id, roads.edges[t].id) for o, t in zip(pairs.origin, pairs.target, strict=True)]
    trips = (
        f'<trip id="t{i}" depart="0" departLane="free" departPos="random_free" from="{start}" to="{end}"/>'
        for i, (start, end) in enumerate(ends * (60 // len(ends) + 1))
        if i < 60
    )
    (tmp_path / "own.rou.xml").write_text(f"<routes>{''.join(trips)}</routes>")
    (tmp_path / "own.sumocfg").write_text(USER_CONFIG)
    shutil.copy(town / "net.xml", tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("source", [{"sumocfg": "own.sumocfg"}, {"network": "net.xml", "routes": ["own.rou.xml"]}])
def test_user_demand_is_simulated_unchanged(crowded_folder, source):
    result = run_stage(traffic, scenario(crowded_folder, **source, **FIVE_FRAMES), crowded_folder / "out")
    assert result["vehicles"] == {"fewest": 60, "most": 60, "different": 60}
    assert not {"--max-num-vehicles", "--max-depart-delay"} & set(result["flags"])


@pytest.mark.slow
def test_user_demand_is_limited_on_request(crowded_folder):
    keys = {"sumocfg": "own.sumocfg", "vehicles": 20, "max_depart_delay_s": 7, **FIVE_FRAMES}
    result = run_stage(traffic, scenario(crowded_folder, **keys), crowded_folder / "out")
    assert result["vehicles"]["fewest"] == result["vehicles"]["most"] == 20
    assert result["flags"][result["flags"].index("--max-depart-delay") + 1] == "7"


COUNT = '[[traffic.counts]]\nedge = "a"\nper_hour = 100'


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('routes = ["r.xml"]\nvehicles_per_lane_km = 3', r"vehicles_per_lane_km has no effect with routes"),
        ("vehicles = 5\nvehicles_per_lane_km = 3", r"vehicles_per_lane_km has no effect with vehicles"),
        ("vehicles = 5\nvehicles_per_h = 300", r"vehicles_per_h has no effect with vehicles"),
        ("vehicles_per_h = 300\nvehicles_per_lane_km = 3", r"vehicles_per_lane_km has no effect with vehicles_per_h"),
        ("vehicles_per_h = 300\ntrips_per_s = 3", r"trips_per_s has no effect with vehicles_per_h"),
        ('vehicles_per_h = 300\nhold = "at_most"', r"hold has no effect with vehicles_per_h"),
        (f"vehicles_per_h = 300\n{COUNT}", r"vehicles_per_h has no effect with counts"),
        (f"reroute_at_departure = true\n{COUNT}", r"reroute_at_departure has no effect with counts"),
    ],
)
def test_rejects_amounts_of_traffic_without_effect(tmp_path, keys, message):
    (tmp_path / "scenario.toml").write_text(
        '[roi]\ncenter_m = [0, 0, 2.5]\nsize_m = [50, 100, 5]\n[sites]\nfile = "s.csv"\n'
        f'[traffic]\nnetwork = "net.xml"\n{keys}\n'
    )
    with pytest.raises(InputError, match=message):
        load(tmp_path)


def test_flags_have_no_absolute_path_and_fcd_file_is_removed(recorded):
    result, _, _, out = recorded
    assert "--max-num-vehicles" in result["flags"] and "--seed" in result["flags"]
    assert not [flag for flag in result["flags"] if Path(flag).is_absolute()]
    assert result["sumo_seconds"] > 0
    names = {p.name for p in (out / "sumo").iterdir()}
    assert {"run.sumocfg", "network.net.xml", "trips.rou.xml", "vtypes.add.xml"} <= names
    assert "fcd.csv" not in names


@pytest.mark.slow
def test_user_configuration_runs_with_times_and_outputs_of_the_scenario(town, tmp_path):
    scene = scenario_with_config(town, tmp_path / "in")
    result = run_stage(traffic, scene, tmp_path / "out")
    text = " ".join(result["flags"])
    assert "--begin 25200.000" in text and "--end 25510.000" in text and "--step-length 1.000" in text
    assert "--time-to-teleport -1" in text
    for dropped in ("tripinfo", "geo", "rerouting.threads", "nowhere"):
        assert dropped not in text
    assert set(inputs_of(traffic, scene, tmp_path).files) == {
        "town.sumocfg",
        "net.xml",
        "own.rou.xml",
        "more/red.add.xml",
    }
    assert result["vehicles"]["different"] > 20


def test_inputs_of_the_stage(town, tmp_path):
    def inputs(folder, **keys):
        return inputs_of(traffic, scenario(folder, network="net.xml", **keys), tmp_path)

    shutil.copytree(town, tmp_path / "elsewhere")
    assert inputs(town, frames=10) == inputs(tmp_path / "elsewhere", frames=10)
    assert inputs(town, frames=10) != inputs(town, frames=11)
    with (tmp_path / "elsewhere" / "net.xml").open("a") as file:
        file.write("\n")
    assert inputs(town, frames=10) != inputs(tmp_path / "elsewhere", frames=10)
