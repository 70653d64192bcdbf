"""Traffic on a straight road, flat or with a hill."""

from pathlib import Path

import numpy as np

from egvs.artefacts import parquet
from egvs.scenario.loading import scenario_from_dict
from egvs.stages import traffic
from egvs.traffic import sumo
from tests.stage_runner import run_stage

HILL = Path(__file__).resolve().parents[2] / "scenarios" / "hill"


GRADE = 0.04


NODES = """<nodes><node id="a" x="0" y="0" z="0"/><node id="b" x="150" y="0" z="0"/>
<node id="c" x="450" y="0" z="{top}"/><node id="d" x="600" y="0" z="{top}"/></nodes>"""


LANES = """<lane index="0" allow="pedestrian" width="2"/><lane index="1" allow="bicycle" width="1.5"/>
<lane index="2" disallow="pedestrian bicycle"/>"""


KINDS = [
    {"name": "car", "length_m": 4.5, "width_m": 1.8, "height_m": 1.5},
    {"name": "bendy", "vclass": "bus", "length_m": 18.75, "width_m": 2.5, "height_m": 3.1},
]


SMALL = {
    "network": "road.net.xml",
    "vehicles": 6,
    "frames": 240,
    "warmup_s": 90.0,
    "trips_per_s": 0.5,
    "kinds": KINDS,
}

CROWD = {"pedestrians_bicycles": {"pedestrians_per_h": 600, "bicycles_per_h": 400}}


def road_scenario(folder, effects=None, **keys):
    values = {
        "name": "trial",
        "seed": 1,
        "roi": {"center_m": [300, 0, 10], "size_m": [60, 40, 20], "voxel_m": 0.5},
        "tpog": {"blocks": 1},
        "sites": {"grid": {"low_m": [300, 10], "high_m": [300, 10], "spacing_m": 1, "heights_m": [12]}},
        "traffic": {"frame_period_s": 0.25, **keys},
        "effects": effects or {},
    }
    return scenario_from_dict(values, folder, str(folder / "scenario.toml"))


def build_road(folder, top, lanes=LANES):
    """A road from x = 0 to 600 m and back, flat, then up to ``top`` between 150 and 450 m, then flat."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "n.nod.xml").write_text(NODES.format(top=top))
    count = lanes.count("<lane")
    ways = [(a, b) for a, b in ("ab", "bc", "cd", "dc", "cb", "ba")]
    edges = "".join(
        f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="{count}" speed="14">{lanes}</edge>' for a, b in ways
    )
    (folder / "e.edg.xml").write_text(f"<edges>{edges}</edges>")
    flags = ["--walkingareas", "--no-turnarounds", "--offset.disable-normalization"]
    sumo.run_program("netconvert", ["-n", "n.nod.xml", "-e", "e.edg.xml", *flags, "-o", "road.net.xml"], folder)
    return folder


def read_rows(out):
    table, _ = parquet.read_artefact(out / "trajectories.parquet", "trajectories")
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def run_and_read(scene, out):
    return run_stage(traffic, scene, out), (out / "trajectories.parquet").read_bytes()


def height_m(x):
    return np.interp(x, [150, 450], [0, 300 * GRADE])
