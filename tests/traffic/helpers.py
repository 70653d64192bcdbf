"""Scenarios and small networks for the tests of the traffic."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pyarrow as pa

from egvs.formats import xml
from egvs.scenario.loading import scenario_from_dict
from egvs.scenario.traffic_config import TrafficConfig, VehicleKind
from egvs.traffic import demand, fcd, network, sumo
from egvs.traffic.fcd import FrameGroup
from egvs.traffic.vehicle_boxes import VehicleSize

SMALL = {"vehicles": 12, "frames": 240, "warmup_s": 60.0, "trips_per_s": 1.0}


def scenario(folder, seed=1, **keys):
    values = {
        "name": "trial",
        "seed": seed,
        "roi": {"center_m": [0, 0, 2.5], "size_m": [50, 100, 5]},
        "tpog": {"blocks": 1},
        "sites": {"grid": {"low_m": [0, 0], "high_m": [1, 1], "spacing_m": 1, "heights_m": [3]}},
        "traffic": {"frame_period_s": 0.25, **keys},
    }
    return scenario_from_dict(values, folder, str(folder / "scenario.toml"))


def netgenerate(folder, *flags, name="net.xml"):
    folder.mkdir(parents=True, exist_ok=True)
    sumo.run_program("netgenerate", [*flags, "-o", name], folder)
    return folder / name


def group_of(rows):
    """rows of (frame, id, type, x, y, angle, speed) -> a FrameGroup."""
    frame, names, types, x, y, angle, speed = zip(*rows, strict=True)
    frame = np.array(frame, dtype=np.int64)
    numbers = [np.array(v, dtype=float) for v in (x, y, np.zeros(len(rows)), angle, np.zeros(len(rows)), speed)]
    table = pa.table([frame * 1000, pa.array(names), pa.array(types), *numbers], schema=fcd.FCD_SCHEMA)
    return FrameGroup(int(frame.min()), int(np.ptp(frame)) + 1, frame, table)


SIZES = {"car": VehicleSize(4.0, 2.0, 1.5, "passenger"), "bus": VehicleSize(12.0, 2.5, 3.0, "bus")}


def car(**keys):
    return VehicleKind(**({"name": "car", "length_m": 4, "width_m": 2, "height_m": 1.5} | keys))


def drawn(**keys):
    return TrafficConfig(network="net.xml", **keys)


def fake_sumo(folder, monkeypatch, script):
    """Have a shell script run instead of SUMO."""
    path = folder / "sumo"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    monkeypatch.setenv("SUMO_BINARY", str(path))


THREE_FRAMES = {"frames": 3, "warmup_s": 1.0, "step_s": 1.0, "frame_period_s": 1.0}
FOREIGN_TEXT = "not SUMO's"


def first_lane(net: Path) -> tuple[str, str, str]:
    """An edge, its first lane, and a signal of a network."""
    edge = next(e for e in xml.iter_elements(net, "net") if e.tag == "edge" and not e.get("id", "").startswith(":"))
    signal = next(e.get("id", "") for e in xml.iter_elements(net, "net") if e.tag == "tlLogic")
    return edge.get("id", ""), f"{edge.get('id', '')}_0", signal


def scenario_with_options(folder: Path, options: str = "", additional: str = "<additional/>"):
    (folder / "own.add.xml").write_text(additional)
    files = '<net-file value="net.xml"/><route-files value="own.rou.xml"/><additional-files value="own.add.xml"/>'
    (folder / "own.sumocfg").write_text(f"<configuration>{files}{options}</configuration>")
    return scenario(folder, sumocfg="own.sumocfg", **THREE_FRAMES)


def serve(folder, *flags):
    """Start SUMO with a TraCI server, as a user would; return the process and the port."""
    from sumolib.miscutils import getFreeSocketPort

    port = getFreeSocketPort()
    command = [str(sumo.sumo_binary("sumo")), "-c", "run.sumocfg", *flags, "--remote-port", str(port)]
    devnull = subprocess.DEVNULL
    process = subprocess.Popen(
        command, cwd=folder, env=sumo.sumo_environment(), stdin=devnull, stdout=devnull, stderr=devnull
    )
    return process, port


USER_ROUTES = """<routes>
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
    result = demand.origin_destination_pairs(roads, car(), drawn(min_trip_m=200), np.random.default_rng(0), "place")
    origin, target = roads.edges[result.origin[0]], roads.edges[result.target[0]]

    def reverse(edge):
        return next(e.id for e in roads.edges if (e.from_node, e.to_node) == (edge.to_node, edge.from_node))

    text = USER_ROUTES.replace("{1b}", reverse(target)).replace("{0b}", reverse(origin))
    return text.replace("{0}", origin.id).replace("{1}", target.id)


USER_CONFIG = """<configuration>
  <input><net-file value="net.xml"/><route-files value="own.rou.xml"/>
    <additional-files value="more/red.add.xml"/></input>
  <output><tripinfo-output value="/nowhere/trips.xml"/><fcd-output.geo value="true"/></output>
  <time><begin value="25200"/><end value="25300"/><step-length value="0.1"/></time>
  <processing><device.rerouting.threads value="4"/><time-to-teleport value="5"/></processing>
</configuration>
"""


def scenario_with_config(town, folder, additional="<additional/>", routes=None):
    (folder / "more").mkdir(parents=True)
    (folder / "own.rou.xml").write_text(
        (routes or routes_for(town)).replace('begin="0" end="100"', 'begin="25200" end="25300"')
    )
    (folder / "more" / "red.add.xml").write_text(additional)
    (folder / "town.sumocfg").write_text(USER_CONFIG)
    shutil.copy(town / "net.xml", folder)
    keys = {"vehicles": 40, "hold": "at_most", "frames": 300, "warmup_s": 10.0, "step_s": 1.0, "frame_period_s": 1.0}
    return scenario(folder, sumocfg="town.sumocfg", **keys)


SMALL_NET = """<net version="1.20">
  <edge id=":j_0" function="internal"><lane id=":j_0_0" index="0" speed="9" length="9" shape="0,0 1,1"/></edge>
  <edge id="in" from="a" to="j"><lane id="in_0" index="0" disallow="bus" shape="-100,0 0,0"/></edge>
  <edge id="back" from="j" to="a"><lane id="back_0" index="0" shape="0,3 -100,3"/></edge>
  <edge id="out" from="j" to="b"><lane id="out_0" index="0" shape="0,0 100,0"/>
    <lane id="out_1" index="1" allow="bicycle" shape="0,-3 100,-3"/></edge>
  <tlLogic id="j" type="actuated" programID="0" offset="0">
    <phase duration="30" maxDur="50" state="GG"/><phase duration="5" state="yy"/></tlLogic>
  <connection from="in" to="out" fromLane="0" toLane="0" via=":j_0_0" dir="s" state="o"/>
  <connection from="in" to="back" fromLane="0" toLane="0" dir="t" state="o"/>
  <connection from=":j_0" to="out" fromLane="0" toLane="0" dir="s" state="o"/>
</net>
"""
