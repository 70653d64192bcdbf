"""Does the traffic stage keep its promises, and refuse what it cannot keep?

Real SUMO on small networks made here.
"""

import json
import math
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from egvs.artefacts import parquet
from egvs.core.errors import InputError, RunError
from egvs.stages import traffic
from egvs.traffic import demand, network, recording, sumo
from tests.stages import inputs_of, run_stage
from tests.traffic.helpers import SMALL, car, drawn, netgenerate, scenario


def test_n_vehicles_are_in_every_frame(recorded):
    result, table, _, _ = recorded
    assert Counter(table["frame"].to_pylist()) == dict.fromkeys(range(240), 12)
    assert result["vehicles"]["fewest"] == result["vehicles"]["most"] == 12
    assert result["frames"] == 240
    assert result["vehicles"]["different"] == len(set(table["vehicle"].to_pylist())) > 12
    assert json.loads(json.dumps(result)) == result


def test_rows_are_sorted_and_tidy(recorded):
    _, table, metadata, _ = recorded
    keys = list(zip(*(table[c].to_pylist() for c in ("frame", "vehicle", "part")), strict=True))
    assert keys == sorted(keys)
    for name in ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad"):
        values = table[name].to_numpy()
        assert not np.signbit(values[values == 0]).any()
        digits = 9 if name.endswith("rad") else 6
        tidy = np.round(values, digits)
        assert np.all((values == tidy) | (values == np.pi))
    assert set(table["pitch_rad"].to_pylist()) == {0.0}
    assert np.array_equal(table["z_m"].to_numpy(), table["height_m"].to_numpy() / 2)
    assert set(table["kind"].to_pylist()) <= {"passenger", "delivery", "truck", "bus"}
    assert metadata["frames"] == 240 and metadata["seed"] == 1 and metadata["sumo"] == sumo.sumo_version()


def test_vehicles_stay_on_the_roads_and_do_not_jump(recorded):
    _, table, _, _ = recorded
    x, y, frame = (table[c].to_numpy() for c in ("x_m", "y_m", "frame"))
    vehicle = np.array(table["vehicle"].to_pylist())
    assert min(x.min(), y.min()) > 0 and max(x.max(), y.max()) < 120 + 90 + 120
    for name in set(vehicle):
        mine = vehicle == name
        assert np.array_equal(np.diff(frame[mine]), np.ones(mine.sum() - 1))
        assert np.hypot(np.diff(x[mine]), np.diff(y[mine])).max(initial=0) < 6  # 0.25 s at less than 24 m/s


def test_flags_name_no_place_of_this_machine_and_the_fcd_file_is_gone(recorded):
    result, _, _, out = recorded
    assert "--max-num-vehicles" in result["flags"] and "--seed" in result["flags"]
    assert not [flag for flag in result["flags"] if Path(flag).is_absolute()]
    assert result["sumo_seconds"] > 0
    names = {p.name for p in (out / "sumo").iterdir()}
    assert {"run.sumocfg", "network.net.xml", "trips.rou.xml", "vtypes.add.xml"} <= names
    assert "fcd.csv" not in names


def test_same_seed_same_bytes_and_another_seed_other_traffic(town, recorded, tmp_path):
    run_stage(traffic, scenario(town, network="net.xml", **SMALL), tmp_path / "again", jobs=1)
    run_stage(traffic, scenario(town, seed=2, network="net.xml", **SMALL), tmp_path / "other")
    first = (recorded[3] / "trajectories.parquet").read_bytes()
    assert (tmp_path / "again" / "trajectories.parquet").read_bytes() == first
    assert (tmp_path / "other" / "trajectories.parquet").read_bytes() != first


def test_the_folder_can_be_moved_and_gives_the_same_traffic_as_a_finished_file(recorded, tmp_path):
    """A user opens run.sumocfg elsewhere, records FCD there, and names that file in a scenario."""
    _, table, _, out = recorded
    moved = tmp_path / "moved"
    shutil.copytree(out / "sumo", moved)
    sumo.run_program("sumo", ["-c", "run.sumocfg", "--fcd-output", "all.xml.gz", "--precision", "8"], moved)
    values = {k: v for k, v in SMALL.items() if k in ("frames", "warmup_s")}
    finished = scenario(moved, fcd="all.xml.gz", **values)
    result = run_stage(traffic, finished, tmp_path / "out")
    again, metadata = parquet.read_artefact(tmp_path / "out" / "trajectories.parquet", "trajectories")
    assert again.equals(table.cast(again.schema))
    assert metadata["sumo"] is None
    assert result["vehicles"]["most"] == 12 and "flags" not in result


def serve(folder, *flags):
    """Start SUMO as a co-simulating user would; its port. (What it prints waits in a buffer: nothing tells when it
    listens.)"""
    from sumolib.miscutils import getFreeSocketPort

    port = getFreeSocketPort()
    command = [str(sumo.sumo_binary("sumo")), "-c", "run.sumocfg", *flags, "--remote-port", str(port)]
    devnull = subprocess.DEVNULL
    process = subprocess.Popen(
        command, cwd=folder, env=sumo.sumo_environment(), stdin=devnull, stdout=devnull, stderr=devnull
    )
    return process, port


def over_traci(scene, out, folder, *flags):
    process, port = serve(folder, *flags)
    with process:
        try:
            return run_stage(traffic, scene, out, traci=("localhost", port))
        finally:
            process.kill()


@pytest.mark.slow
@pytest.mark.usefixtures("patient")
def test_traci_records_the_same_bytes(town, recorded, tmp_path):
    result, _, _, out = recorded
    polled = over_traci(scenario(town, network="net.xml", **SMALL), tmp_path, out / "sumo")
    assert (tmp_path / "trajectories.parquet").read_bytes() == (out / "trajectories.parquet").read_bytes()
    assert {k: v for k, v in polled.items() if k not in ("flags", "sumo_seconds")} == {
        k: v for k, v in result.items() if k not in ("flags", "sumo_seconds")
    }


@pytest.mark.usefixtures("patient")
def test_traci_refuses_another_step_and_a_clock_that_is_too_late(town, recorded, tmp_path):
    folder = recorded[3] / "sumo"
    with pytest.raises(InputError, match=r"expected steps of 0\.125 s, got 0\.25 s"):
        over_traci(scenario(town, network="net.xml", **SMALL, step_s=0.125), tmp_path, folder)
    with pytest.raises(RunError, match=r"SUMO is at 70 s already, after the first frame at 60 s"):
        over_traci(scenario(town, network="net.xml", **SMALL), tmp_path, folder, "--begin", "70")
    assert not (tmp_path / "trajectories.parquet").exists()


def test_traci_to_nobody_is_refused(town, tmp_path):
    from sumolib.miscutils import getFreeSocketPort

    with pytest.raises(InputError, match="no SUMO answers there"):
        run_stage(
            traffic, scenario(town, network="net.xml", **SMALL), tmp_path, traci=("localhost", getFreeSocketPort())
        )


@pytest.mark.parametrize(
    "answer", [b"", b"HTTP/1.1 400 Bad Request\r\n", b"\0\0\0\5\0", b"\0\0\0\x0b\7\0\0\0\0\0\0", b"\0\0\0\4"]
)
def test_who_does_not_answer_as_sumo_does_is_refused(town, tmp_path, monkeypatch, answer):
    """One that listens and is silent, and some that say something else, and wait."""
    monkeypatch.setattr(sumo, "_ANSWER_TIMEOUT_S", 0.2)
    with socket.create_server(("localhost", 0)) as server, ThreadPoolExecutor(1) as threads:
        taken = threads.submit(server.accept)
        port = server.getsockname()[1]
        answered = threads.submit(lambda: taken.result()[0].sendall(answer))
        with pytest.raises(InputError, match=r"the server there does not answer as SUMO does within 0\.2 s"):
            run_stage(traffic, scenario(town, network="net.xml", **SMALL), tmp_path, traci=("localhost", port))
        answered.result()
        taken.result()[0].close()
    assert not (tmp_path / "trajectories.parquet").exists()


@pytest.mark.usefixtures("patient")
def test_a_sumo_that_falls_silent_is_told(town, recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(sumo, "_STEP_TIMEOUT_S", 0.2)
    process, port = serve(recorded[3] / "sumo")
    with process:
        try:
            with (
                pytest.raises(RunError, match=rf"SUMO at localhost:{port} closed .*, or did not answer for 0\.2 s"),
                sumo.connect_traci("localhost", port) as connection,
            ):
                process.send_signal(signal.SIGSTOP)
                connection.simulationStep()
        finally:
            process.kill()


ROUTES = """<routes>
  <vType id="lorry" vClass="trailer"/>
  <vType id="mini" length="3" width="1.5" height="1.4"/>
  <flow id="l" type="lorry" from="{0}" to="{1}" begin="0" end="100" period="6"/>
  <flow id="m" type="mini" from="{1b}" to="{0b}" begin="0" end="100" period="3"/>
  <vehicle id="parked" type="mini" depart="0"><route edges="{0}"/>
    <stop lane="{0}_0" endPos="60" duration="900"/></vehicle>
</routes>
"""


def routes_for(town):
    roads = network.read_net_xml(town / "net.xml")
    found = demand.origin_destination_pairs(roads, car(), drawn(min_trip_m=200), np.random.default_rng(0), "place")
    origin, target = roads.edges[found.origin[0]], roads.edges[found.target[0]]

    def reverse(edge):
        return next(e.id for e in roads.edges if (e.from_node, e.to_node) == (edge.to_node, edge.from_node))

    text = ROUTES.replace("{1b}", reverse(target)).replace("{0b}", reverse(origin))
    return text.replace("{0}", origin.id).replace("{1}", target.id)


def test_own_routes_get_their_sizes_from_sumo(town, tmp_path):
    (tmp_path / "own.rou.xml").write_text(routes_for(town))
    shutil.copy(town / "net.xml", tmp_path)
    keys = {
        "network": "net.xml",
        "routes": ["own.rou.xml"],
        "vehicles": 30,
        "hold": "at_most",
        "step_s": 1,
        "frame_period_s": 1,
    }
    result = run_stage(traffic, scenario(tmp_path, **keys, frames=300, warmup_s=10), tmp_path / "out")
    table, _ = parquet.read_artefact(tmp_path / "out" / "trajectories.parquet", "trajectories")
    sizes = {(r["kind"], r["length_m"], r["width_m"], r["height_m"]) for r in table.to_pylist()}
    assert sizes == {("trailer", 16.5, 2.55, 4.0), ("passenger", 3.0, 1.5, 1.4)}
    assert result["longest_standing_s"] > 200  # parked on purpose, which is no jam
    assert set(inputs_of(traffic, scenario(tmp_path, **keys), tmp_path).files) == {"net.xml", "own.rou.xml"}


CONFIG = """<configuration>
  <input><net-file value="net.xml"/><route-files value="own.rou.xml"/>
    <additional-files value="more/red.add.xml"/></input>
  <output><tripinfo-output value="/nowhere/trips.xml"/><fcd-output.geo value="true"/></output>
  <time><begin value="25200"/><end value="25300"/><step-length value="0.1"/></time>
  <processing><device.rerouting.threads value="4"/><time-to-teleport value="5"/></processing>
</configuration>
"""


def configured(town, folder, additional="<additional/>", routes=None):
    (folder / "more").mkdir(parents=True)
    (folder / "own.rou.xml").write_text(
        (routes or routes_for(town)).replace('begin="0" end="100"', 'begin="25200" end="25300"')
    )
    (folder / "more" / "red.add.xml").write_text(additional)
    (folder / "town.sumocfg").write_text(CONFIG)
    shutil.copy(town / "net.xml", folder)
    keys = {"vehicles": 40, "hold": "at_most", "frames": 300, "warmup_s": 10.0, "step_s": 1.0, "frame_period_s": 1.0}
    return scenario(folder, sumocfg="town.sumocfg", **keys)


def test_own_configuration_runs_with_the_scenarios_times_and_outputs(town, tmp_path):
    scene = configured(town, tmp_path / "in")
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


def test_a_jam_without_end_fails_with_its_numbers(town, tmp_path):
    """All signals of the town stay red."""
    text = (town / "net.xml").read_text()
    red = [
        f'<tlLogic id="{name}" type="static" programID="red" offset="0">'
        f'<phase duration="60" state="{"r" * len(state)}"/></tlLogic>'
        for name, state in re.findall(r'<tlLogic id="([^"]+)".*?state="([^"]+)"', text, re.S)
    ]
    assert len(red) == 4
    scene = configured(town, tmp_path / "in", f"<additional>{''.join(red)}</additional>")
    with pytest.raises(RunError, match=r"vehicles stand for more than 180 s up to the last frame, .* for 2\d\d s"):
        run_stage(traffic, scene, tmp_path / "out")
    assert not (tmp_path / "out" / "trajectories.parquet").exists()
    assert not (tmp_path / "out" / "sumo" / "fcd.csv").exists()


def test_patience_is_two_cycles_and_three_minutes_at_least():
    assert recording.standing_limit_s(70) == 180
    assert recording.standing_limit_s(120) == 240


@pytest.mark.slow
def test_more_vehicles_than_the_town_holds_fail_with_the_numbers(town, tmp_path):
    keys = SMALL | {"vehicles": 200, "frames": 40}
    with pytest.raises(
        RunError, match=r"traffic: expected 200 vehicles in every frame, got them in 0 of 40 frames \(min \d+, max \d+;"
    ):
        run_stage(traffic, scenario(town, network="net.xml", **keys), tmp_path)
    result = run_stage(traffic, scenario(town, network="net.xml", **keys, hold="at_most"), tmp_path)
    assert 0 < result["vehicles"]["most"] < 200


def test_no_vehicle_at_all_fails(town, tmp_path):
    (tmp_path / "none.rou.xml").write_text("<routes/>")
    keys = SMALL | {"routes": ["none.rou.xml"], "hold": "at_most"}
    keys.pop("trips_per_s")
    shutil.copy(town / "net.xml", tmp_path)
    with pytest.raises(RunError, match=r"no vehicle of none\.rou\.xml is in any of 240 frames"):
        run_stage(traffic, scenario(tmp_path, network="net.xml", **keys), tmp_path / "out")


NODES = """<nodes><node id="a" x="0" y="0" z="0"/><node id="b" x="400" y="0" z="40"/>
<node id="c" x="800" y="0" z="40"/></nodes>"""
EDGES = """<edges><edge id="ab" from="a" to="b" numLanes="2"/><edge id="bc" from="b" to="c" numLanes="2"/></edges>"""


@pytest.mark.slow
def test_uphill_boxes_are_pitched_and_stand_on_the_road(tmp_path):
    (tmp_path / "n.nod.xml").write_text(NODES)
    (tmp_path / "e.edg.xml").write_text(EDGES)
    sumo.run_program("netconvert", ["-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "hill.net.xml"], tmp_path)
    keys = SMALL | {"network": "hill.net.xml", "vehicles": 8, "frames": 120, "hold": "at_most"}
    run_stage(traffic, scenario(tmp_path, **keys), tmp_path / "out")
    table, _ = parquet.read_artefact(tmp_path / "out" / "trajectories.parquet", "trajectories")
    uphill = [r for r in table.to_pylist() if 20 < r["x_m"] < 380]
    assert len(uphill) > 50
    for r in uphill:
        assert r["pitch_rad"] == pytest.approx(math.atan(0.1), abs=1e-3)
        assert r["z_m"] - r["height_m"] / 2 == pytest.approx(0.1 * r["x_m"], abs=0.05)
        assert r["yaw_rad"] == pytest.approx(0, abs=1e-2)


def test_a_ring_gets_trips_between_any_edges_and_says_so(tmp_path):
    netgenerate(
        tmp_path,
        "--spider",
        "--spider.arm-number",
        "6",
        "--spider.circle-number",
        "1",
        "--spider.omit-center",
        name="ring.net.xml",
    )
    result = run_stage(
        traffic, scenario(tmp_path, **(SMALL | {"network": "ring.net.xml", "vehicles": 5})), tmp_path / "out"
    )
    assert result["notes"] and "no trip between fringe edges" in result["notes"][0]


OSM = """<osm version="0.6"><bounds minlat="52.0" minlon="10.0" maxlat="52.004" maxlon="10.004"/>
{nodes}
<way id="1"><nd ref="1"/><nd ref="2"/><nd ref="3"/><tag k="highway" v="secondary"/></way>
<way id="2"><nd ref="4"/><nd ref="2"/><nd ref="5"/><tag k="highway" v="secondary"/></way></osm>
"""


def test_a_map_of_openstreetmap_becomes_a_network(tmp_path):
    where = [(52.002, 10.0), (52.002, 10.002), (52.002, 10.004), (52.0, 10.002), (52.004, 10.002)]
    nodes = "".join(f'<node id="{i}" lat="{lat}" lon="{lon}"/>' for i, (lat, lon) in enumerate(where, 1))
    (tmp_path / "cross.osm").write_text(OSM.replace("{nodes}", nodes))
    result = run_stage(
        traffic, scenario(tmp_path, **(SMALL | {"network": "cross.osm", "vehicles": 6})), tmp_path / "out"
    )
    assert result["vehicles"]["fewest"] == 6
    assert (tmp_path / "out" / "sumo" / "network.net.xml").is_file()


def test_progress_goes_on_to_the_end(town, tmp_path):
    heard = []
    run_stage(traffic, scenario(town, network="net.xml", **SMALL), tmp_path, progress=lambda *what: heard.append(what))
    assert heard[-1] == ("frames written", 240, 240)


def test_the_time_of_a_growing_file_is_that_of_its_last_whole_row(tmp_path):
    path = tmp_path / "fcd.csv"
    assert recording._last_time_ms(path) is None
    path.write_text("timestep_time;vehicle_id\n")
    assert recording._last_time_ms(path) is None
    path.write_text("timestep_time;vehicle_id\n1.250;a\n1.5")
    assert recording._last_time_ms(path) == 1250


def test_inputs_depend_on_what_the_stage_reads_and_on_nothing_else(town, tmp_path):
    def about(folder, **keys):
        return inputs_of(traffic, scenario(folder, network="net.xml", **keys), tmp_path)

    shutil.copytree(town, tmp_path / "elsewhere")
    assert about(town, frames=10) == about(tmp_path / "elsewhere", frames=10)
    assert about(town, frames=10) != about(town, frames=11)
    with (tmp_path / "elsewhere" / "net.xml").open("a") as file:
        file.write("\n")
    assert about(town, frames=10) != about(tmp_path / "elsewhere", frames=10)


@pytest.mark.slow
def test_importing_the_stage_loads_no_tool_of_sumo():
    code = "import sys, egvs.stages.traffic; print([m for m in ('sumolib', 'traci') if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
