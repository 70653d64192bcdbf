"""Traffic that SUMO simulates: vehicles at a constant speed, whose positions are known by hand."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from tests.planted.case import Case, add, both, file, key, make, text
from tests.planted.scenes import Scene
from tests.planted.truth import SIZES_M, STREET, drive, traffic

SPEED_M_S = 10.0
DEPART_M = 25.3
"""Position of the front bumper on its lane at the time 0: the lane to the east begins at x = -40 m."""

LANE_START_M, LANE_END_M, LANE_Y_M = -40.0, 90.0, 1.6
STEP_M = SPEED_M_S * 0.5

SIMULATED_TRUTH = replace(
    STREET,
    periods=(
        (
            1.0,
            traffic(
                drive("a", "car", LANE_START_M + DEPART_M - 0.5 * SIZES_M["car"][0], -LANE_Y_M, STEP_M, 16),
                drive("b", "truck", LANE_END_M - DEPART_M + 0.5 * SIZES_M["truck"][0], LANE_Y_M, -STEP_M, 16),
            ),
        ),
    ),
)
"""A car and a truck for eight seconds, until they leave the network."""


def network(location: str = 'netOffset="0.00,0.00" projParameter="!"') -> str:
    """The street as SUMO needs it, with the ends of its roads."""
    edges, junctions = "", ""
    for name, start_m, end_m, y_m in (
        ("east", LANE_START_M, LANE_END_M, -LANE_Y_M),
        ("west", LANE_END_M, LANE_START_M, LANE_Y_M),
    ):
        lane = f'<lane id="{name}_0" index="0" speed="13.9" length="130" shape="{start_m},{y_m} {end_m},{y_m}"/>'
        edges += f'<edge id="{name}" from="{name}_a" to="{name}_b" priority="1">{lane}</edge>\n'
        for end, x_m in (("a", start_m), ("b", end_m)):
            lanes = f"{name}_0" if end == "b" else ""
            junctions += (
                f'<junction id="{name}_{end}" type="dead_end" x="{x_m}" y="{y_m}" incLanes="{lanes}" intLanes=""'
                f' shape="{x_m},{y_m}"/>\n'
            )
    boundary = 'convBoundary="-40,-2,90,2" origBoundary="-40,-2,90,2"'
    return f'<net version="1.20">\n<location {location} {boundary}/>\n{edges}{junctions}</net>\n'


def routes(depart_s: float = 0.0) -> str:
    """Two vehicles that never change their speed."""
    types, vehicles = "", ""
    for name, edge, vehicle in (("car", "east", "a"), ("truck", "west", "b")):
        length_m, width_m, height_m = SIZES_M[name]
        vclass = {"car": "passenger", "truck": "truck"}[name]
        types += (
            f'<vType id="{name}" vClass="{vclass}" length="{length_m}" width="{width_m}" height="{height_m}" sigma="0"'
            f' maxSpeed="{SPEED_M_S}" speedFactor="1" speedDev="0"/>\n'
        )
        start = f'depart="{depart_s}" departPos="{DEPART_M}" departSpeed="{SPEED_M_S}"'
        vehicles += f'<vehicle id="{vehicle}" type="{name}" {start}><route edges="{edge}"/></vehicle>\n'
    return f"<routes>\n{types}{vehicles}</routes>\n"


def configuration(additional: str = "") -> str:
    """A configuration of SUMO."""
    more = f'<additional-files value="{additional}"/>' if additional else ""
    names = '<net-file value="net.net.xml"/><route-files value="own.rou.xml"/>'
    return f"<configuration><input>{names}{more}</input></configuration>\n"


def simulated(scene: Scene, additional: str = "") -> None:
    """Give a scene a simulation instead of its finished file."""
    for name in ("traffic.fcd", "traffic.roads", "traffic.kinds"):
        del scene.config[name]
    del scene.files["fcd.csv"]
    scene.config |= {
        "traffic.sumocfg": "own.sumocfg", "traffic.frames": 16, "traffic.warmup_s": 0, "traffic.step_s": 0.25,
    }  # fmt: skip
    scene.files |= {
        "net.net.xml": network(), "own.rou.xml": routes(), "own.sumocfg": configuration(additional),
    }  # fmt: skip


OTHER_LOCATION = '<additional><location netOffset="0.00,0.00" projParameter="!"/></additional>'
RUN = make(simulated, truth=SIMULATED_TRUTH)
WITH_MORE = make(
    partial(simulated, additional="more.add.xml"), add("more.add.xml", OTHER_LOCATION), truth=SIMULATED_TRUTH
)
simulated_case = partial(Case, starts_processes=True)

SIMULATED = (
    simulated_case(
        "routes without vehicles",
        RUN,
        file("own.rou.xml", lambda _: '<routes><vType id="car"/></routes>'),
        "traffic.sumocfg = 'own.sumocfg'",
        "no vehicle, trip or flow in its files",
    ),
    simulated_case(
        "vehicles that depart after the recording",
        RUN,
        file("own.rou.xml", lambda _: routes(900.0)),
        "scenario.toml: traffic",
        "no vehicle of own.sumocfg is in any of 16 frames",
    ),
    simulated_case(
        "additional file of another network",
        WITH_MORE,
        text("more.add.xml", '"0.00,0.00"', '"55.00,0.00"'),
        "more.add.xml",
        "states netOffset 55,0",
    ),
    simulated_case(
        "frames between the steps of SUMO",
        RUN,
        key("traffic.step_s", 0.3),
        "frame_period_s = 0.5",
        "expected a multiple of the step of 0.3 s",
    ),
    simulated_case(
        "sizes of a vType in centimetres",
        RUN,
        both(text("own.rou.xml", 'length="4.5"', 'length="450"'), text("own.rou.xml", 'width="1.8"', 'width="180"')),
        "scenario.toml: traffic",
        "car (passenger): 450 x 180 x 1.5 m",
        is_error=False,
    ),
    simulated_case(
        "route over an edge that is not there",
        RUN,
        text("own.rou.xml", 'edges="west"', 'edges="north"'),
        "scenario.toml: traffic",
        "The edge 'north' within the route for vehicle 'b' is not known",
    ),
)
