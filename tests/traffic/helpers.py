"""Scenarios and small networks for the tests of the traffic."""

import numpy as np
import pyarrow as pa

from egvs.scenario.loading import scenario_from_dict
from egvs.scenario.traffic_config import TrafficConfig, VehicleKind
from egvs.traffic import fcd, sumo
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
