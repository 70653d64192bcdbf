"""Does the traffic stage answer wrong input with what would be right?"""

import shutil

import pytest

from egvs.core.errors import InputError
from egvs.stages import traffic
from tests.stages import run_stage
from tests.traffic.helpers import car, scenario


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
        r"traffic\.frame_period_s = 0\.3: is no whole number of steps of 0\.25 s; for example 0\.25 or 0\.5",
    ),
    "warm-up between steps": (
        nothing,
        {"network": "net.xml", "warmup_s": 10.1},
        InputError,
        r"warmup_s = 10\.1: is no whole",
    ),
    "step below a millisecond": (
        nothing,
        {"network": "net.xml", "step_s": 0.0004},
        InputError,
        r"step_s = 0\.0004: is no whole number of milliseconds",
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
        r"m\.osm\.pbf: cannot be read as OpenStreetMap data",
    ),
    "no routes": (
        nothing,
        {"network": "net.xml", "routes": ["r.xml"]},
        InputError,
        r"traffic\.routes = 'r\.xml': no such file",
    ),
    "empty network": (write("e.xml", "<net/>"), {"network": "e.xml"}, InputError, r"e\.xml: the network has no road"),
    "no network inside": (
        write("e.xml", "<routes/>"),
        {"network": "e.xml"},
        InputError,
        r"e\.xml: expected the root <net>, got <routes>",
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
        r"<edge id='a'> is not as in a",
    ),
    "kind unknown to SUMO": (
        nothing,
        {"network": "net.xml", "kinds": [car(vclass="saucer").model_dump()]},
        InputError,
        r"kind 'car' has the unknown vClass 'saucer'",
    ),
    "trips too long": (nothing, {"network": "net.xml", "min_trip_m": 5000}, InputError, r"no trip of at least 5000 m"),
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
        r"c\.sumocfg: names no net-file",
    ),
    "configuration names a missing file": (
        write("c.sumocfg", '<configuration><net-file value="gone.xml"/></configuration>'),
        {"sumocfg": "c.sumocfg"},
        InputError,
        r"c\.sumocfg: net-file = 'gone\.xml': no such file",
    ),
    "configuration lets vehicles jump": (
        write(
            "c.sumocfg", '<configuration><net-file value="net.xml"/><no-internal-links value="true"/></configuration>'
        ),
        {"sumocfg": "c.sumocfg"},
        InputError,
        r"no-internal-links = 'true': lets vehicles jump",
    ),
    "unknown type in a finished file": (
        write("f.csv", f"{FCD}\n0;v;1;2;3;tram\n1;v;1;2;3;tram\n"),
        {"fcd": "f.csv", "frames": 1, "warmup_s": 0, "frame_period_s": 1},
        InputError,
        r"vehicle type 'tram' of f.csv has no known size",
    ),
    "too few frames in a finished file": (
        write("f.csv", f"{FCD}\n0;v;1;2;3;car\n1;v;1;2;3;car\n"),
        {"fcd": "f.csv", "frames": 9, "warmup_s": 0, "frame_period_s": 1},
        InputError,
        r"frames = 9: \S+ has 2 frames",
    ),
}


@pytest.mark.parametrize(("prepare", "keys", "error", "message"), BAD.values(), ids=BAD.keys())
def test_wrong_input_is_answered_with_what_would_be_right(town, tmp_path, prepare, keys, error, message):
    shutil.copy(town / "net.xml", tmp_path)
    prepare(tmp_path)
    with pytest.raises(error, match=message):
        run_stage(traffic, scenario(tmp_path, **keys), tmp_path / "out")
    assert not (tmp_path / "out" / "trajectories.parquet").exists()


def test_traci_beside_a_finished_file_is_refused(tmp_path):
    (tmp_path / "f.csv").write_text("x")
    with pytest.raises(InputError, match="--traci: the scenario names a finished FCD file"):
        run_stage(traffic, scenario(tmp_path, fcd="f.csv"), tmp_path, traci=("localhost", 1))


def test_a_file_in_the_folder_that_is_made_anew_is_kept(town, tmp_path):
    own = tmp_path / "sumo" / "net.xml"
    own.parent.mkdir()
    shutil.copy(town / "net.xml", own)
    with pytest.raises(InputError, match=r"sumo/net\.xml: lies in the folder that is made anew for SUMO; another"):
        run_stage(traffic, scenario(tmp_path, network="sumo/net.xml"), tmp_path)
    assert own.is_file()


def test_what_an_earlier_run_left_is_gone(town, tmp_path):
    left = tmp_path / "sumo" / "fcd.csv"
    left.parent.mkdir()
    left.write_text("another run's")
    keys = {"network": "net.xml", "frames": 2, "warmup_s": 0.0, "vehicles": 1, "hold": "at_most"}
    with left.open("a") as still_written:
        run_stage(traffic, scenario(town, **keys), tmp_path)
        still_written.write("more")
    assert not left.exists() and (tmp_path / "trajectories.parquet").is_file()
