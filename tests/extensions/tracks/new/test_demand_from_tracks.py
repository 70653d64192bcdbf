"""egvs new --like: the demand of a scenario from recorded tracks."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import egvs
from egvs.core.errors import InputError
from egvs.creation.new_scenario import NewScenarioOptions, create_scenario
from egvs.extensions.tracks.new.demand import TrackDemand
from egvs.scenario.model import SCENARIO_FILE
from egvs.statistics import intervals
from egvs.traffic import sumo
from tests.extensions.tracks.new.test_recorded_traffic import HEADER, K733
from tests.traffic.crossing import NETWORK

SECONDS = 600

STRAIGHT, LEFT = ((-110.0, 0.0), (110.0, 0.0)), ((-110.0, 0.0), (0.0, 0.0), (0.0, 110.0))


def vehicle(
    number: int, begin_s: float, way_m: Sequence[tuple[float, float]], speed_m_s: float, kind: str, size: str
) -> Iterable[str]:
    """Yield the rows of a vehicle at constant speed, without headings."""
    corners = np.array(way_m)
    along_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(corners, axis=0).T)))
    for step in range(int(along_m[-1] / speed_m_s / 0.5) + 1):
        x_m, y_m = (np.interp(speed_m_s * 0.5 * step, along_m, corners[:, axis]) for axis in (0, 1))
        yield f"{number},{step},{1000 * begin_s + 500 * step:.0f},{kind},{x_m:.3f},{y_m:.3f},,,,{size}"


def write_recording(path: Path) -> Path:
    """Write ten minutes: 25 cars straight on at 90 to 114 % of 10 m/s, 3 trucks to the left, a pedestrian."""
    rows: list[str] = []
    for number in range(25):
        size = f"{4.0 + 0.02 * number:.2f},1.80"
        rows += vehicle(number, 10.0 + 20.0 * number, STRAIGHT, 9.0 + 0.1 * number, "car", size)
    for number in range(3):
        rows += vehicle(100 + number, 200.0 * number, LEFT, 8.0, "truck", "9.00,2.50")
    rows += [f"P1,{k},{1000 * k},pedestrian,-20.0,{k / 10:.1f},,,,," for k in range(SECONDS + 1)]
    path.write_text("\n".join([HEADER, *rows, ""]), encoding="utf-8")
    return path


@pytest.fixture
def network_path(tmp_path: Path) -> Path:
    path = tmp_path / "crossing.net.xml"
    path.write_text(NETWORK, encoding="utf-8")
    return path


def new_like(folder: Path, network: Path, tracks: Path):  # type: ignore[no-untyped-def]
    return create_scenario(folder, network, options=NewScenarioOptions(like=(tracks,), track_crs="world"))


def test_counts_of_a_recording(tmp_path: Path, network_path: Path) -> None:
    """25 vehicles in ten minutes are 150 an hour; Garwood's limits for 25 are 16.18 and 36.90."""
    new = new_like(tmp_path / "new", network_path, write_recording(tmp_path / "tracks.csv"))
    assert isinstance(new.traffic, TrackDemand)
    assert new.traffic.duration_s == SECONDS
    assert {(flow.from_edge, flow.to_edge): flow.per_hour for flow in new.flows} == {
        ("in", "out"): 150.0, ("in", "north"): 18.0,
    }  # fmt: skip
    straight, left = sorted(new.traffic.movements, key=lambda movement: -movement.vehicles)
    assert (straight.low_per_h, straight.high_per_h) == pytest.approx((6 * 16.1787, 6 * 36.9049), abs=0.01)
    assert straight.comment == "95 %: 97 to 221, from 25 vehicles"
    assert left.comment == "95 %: 4 to 53 (3 vehicles only; enter your own count)"
    assert new.traffic.marked == 1
    assert any("1 pedestrian" in note for note in new.notes)


def test_fleet_of_a_recording(tmp_path: Path, network_path: Path) -> None:
    new = new_like(tmp_path / "new", network_path, write_recording(tmp_path / "tracks.csv"))
    traffic = egvs.load(tmp_path / "new").traffic
    car, truck = traffic.kinds
    assert (car.name, car.share, car.length_m, car.width_m, car.height_m) == ("car", 0.8929, 4.24, 1.8, 1.5)
    assert (truck.name, truck.vclass, truck.length_m) == ("truck", "truck", 9.0)
    # the mean is 10.2 m/s; SUMO's drivers dawdle by 0.5 * 2.6 * 0.25 / 2 m/s on average
    deviation = np.std([0.9 + 0.01 * number for number in range(25)], ddof=1)
    assert car.attributes == {"speedFactor": f"normc({1.02 + 0.1625 / 10:.3f},{deviation:.3f},0.2,2)"}
    assert truck.attributes == {}
    assert isinstance(new.traffic, TrackDemand)
    assert [estimate.has_default_size for estimate in new.traffic.fleet] == [False, True]
    assert "sizes of vehicles (truck)" in new.traffic.assumptions


def test_intervals_and_marks_are_in_the_scenario(tmp_path: Path, network_path: Path) -> None:
    new_like(tmp_path / "new", network_path, write_recording(tmp_path / "tracks.csv"))
    text = (tmp_path / "new" / SCENARIO_FILE).read_text(encoding="utf-8")
    assert "95 %: 97 to 221, from 25 vehicles" in text
    assert "(3 vehicles only; enter your own count)" in text
    assert "speedFactor mean 95 %: " in text
    assert "SUMO's default, since fewer than 20 vehicles show another value: speedFactor (3)" in text
    assert "# For peaks, add tables [[traffic.periods]]" in text
    scenario = egvs.load(tmp_path / "new")
    assert scenario.traffic.tracks is None
    assert "counts of 1 of 2 movements (with fewer than 20 recorded vehicles)" in scenario.assumed


def test_command_prints_counts_and_warns(run_egvs, tmp_path: Path, network_path: Path) -> None:
    tracks = write_recording(tmp_path / "tracks.csv")
    options = ["--like", tracks, "--track-crs", "world"]
    code, out, err = run_egvs("new", tmp_path / "new", "--from", network_path, *options)
    assert (code, err) == (0, "")
    assert "28 recorded vehicles in 600 s became 168 an hour in 2 movements, 1 of them with fewer than 20" in out
    assert "warning: 1 of 2 counts come from fewer than 20 vehicles" in out


def test_rejects_tracks_that_pass_no_junction(tmp_path: Path, network_path: Path) -> None:
    rows = vehicle(1, 0.0, ((-110.0, 0.0), (-50.0, 0.0)), 8.0, "car", "4.5,1.8")
    (tmp_path / "tracks.csv").write_text("\n".join([HEADER, *rows, ""]), encoding="utf-8")
    with pytest.raises(InputError, match="no recorded vehicle passes a junction of the network"):
        new_like(tmp_path / "new", network_path, tmp_path / "tracks.csv")
    assert not (tmp_path / "new").exists()


def test_rejects_recording_of_pedestrians(tmp_path: Path, network_path: Path) -> None:
    rows = [f"P1,{k},{1000 * k},pedestrian,-20.0,{k / 10:.1f},,,,," for k in range(60)]
    (tmp_path / "tracks.csv").write_text("\n".join([HEADER, *rows, ""]), encoding="utf-8")
    with pytest.raises(InputError, match="no recorded vehicle passes a junction of the network"):
        new_like(tmp_path / "new", network_path, tmp_path / "tracks.csv")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tracks": True, "like": True}, "--like: cannot be combined with --tracks"),
        (
            {"tracks": True, "pedestrian_tracks": True},
            "--pedestrian-tracks: is for simulated vehicles, not for --tracks",
        ),
    ],
)
def test_rejects_options_that_exclude_each_other(
    tmp_path: Path, network_path: Path, options: dict[str, bool], message: str
) -> None:
    tracks = write_recording(tmp_path / "tracks.csv")
    with pytest.raises(InputError, match=message):
        create_scenario(tmp_path / "new", network_path, options=NewScenarioOptions(**dict.fromkeys(options, (tracks,))))


def test_like_excludes_assumed_traffic(run_egvs, tmp_path: Path, network_path: Path) -> None:
    tracks = write_recording(tmp_path / "tracks.csv")
    options = ["--like", tracks, "--traffic", "heavy"]
    code, _, err = run_egvs("new", tmp_path / "new", "--from", network_path, *options)
    assert code == 2
    assert "--traffic: has no effect on recorded traffic (--like)" in err


TRUE_FLOWS = {("ei", "wo"): 540.0, ("wi", "eo"): 430.0, ("wi", "no"): 100.0, ("si", "no"): 180.0}
TRUE_SPEED, TRUE_DEVIATION, TRUCK_SHARE, MIN_GAP_M = 1.1, 0.08, 0.12, 2.0
WARMUP_S, END_S = 120, 1920

_ROUTES = """<routes>
<vTypeDistribution id="fleet">
<vType id="car" vClass="passenger" length="4.5" width="1.8" minGap="{gap}" speedFactor="normc({mean},{dev},0.2,2)"
 probability="{cars}"/>
<vType id="truck" vClass="truck" length="9" width="2.5" probability="{trucks}"/>
</vTypeDistribution>
{flows}
</routes>
"""

_NODES = """<nodes><node id="c" x="0" y="0" type="traffic_light"/><node id="e" x="250" y="0"/>
<node id="w" x="-250" y="0"/><node id="n" x="0" y="250"/><node id="s" x="0" y="-250"/></nodes>"""


def simulate(folder: Path) -> tuple[Path, Path]:
    """Simulate a signalised crossing; return its network, and the vehicles as recorded tracks."""
    (folder / "map.nod.xml").write_text(_NODES)
    edges = []
    for name, lanes in (("e", 2), ("w", 2), ("n", 1), ("s", 1)):
        edges.append(f'<edge id="{name}i" from="{name}" to="c" numLanes="{lanes}" speed="13.89"/>')
        edges.append(f'<edge id="{name}o" from="c" to="{name}" numLanes="{lanes}" speed="13.89"/>')
    (folder / "map.edg.xml").write_text(f"<edges>{''.join(edges)}</edges>")
    sumo.run_netconvert(["-n", "map.nod.xml", "-e", "map.edg.xml", "--no-turnarounds"], folder, "map.net.xml")
    flows = [
        f'<flow id="{start}{end}" from="{start}" to="{end}" type="fleet" begin="0" end="{END_S}"'
        f' period="exp({per_hour / 3600})" departSpeed="max" departLane="best"/>'
        for (start, end), per_hour in TRUE_FLOWS.items()
    ]
    text = _ROUTES.format(
        gap=MIN_GAP_M, mean=TRUE_SPEED, dev=TRUE_DEVIATION, cars=1 - TRUCK_SHARE, trucks=TRUCK_SHARE,
        flows="\n".join(flows),
    )  # fmt: skip
    (folder / "map.rou.xml").write_text(text)
    options = ["-n", "map.net.xml", "-r", "map.rou.xml", "--step-length", "0.25", "--end", str(END_S), "--seed", "7"]
    options += ["--fcd-output", "fcd.xml", "--device.fcd.period", "0.5", "--device.fcd.begin", str(WARMUP_S)]
    sumo.run_program("sumo", [*options, "--lateral-resolution", "0.8", "--no-step-log"], folder)

    rows = []
    sizes = {"car": (4.5, 1.8), "truck": (9.0, 2.5)}
    for _, element in ElementTree.iterparse(folder / "fcd.xml"):
        if element.tag != "timestep" or float(element.get("time", 0)) < WARMUP_S:
            continue
        for row in element:
            kind = row.attrib["type"].partition("@")[0]
            length_m, width_m = sizes[kind]
            yaw_rad = np.deg2rad(90.0 - float(row.attrib["angle"]))
            x_m = float(row.attrib["x"]) - length_m / 2 * np.cos(yaw_rad)
            y_m = float(row.attrib["y"]) - length_m / 2 * np.sin(yaw_rad)
            # sizes that vary a little, so that they are not taken for defaults of the recording
            size = f"{length_m + 1e-4 * (len(rows) % 7)},{width_m}"
            time_ms = round(1000 * float(element.attrib["time"]))
            rows.append(f"{row.attrib['id']},0,{time_ms},{kind},{x_m:.3f},{y_m:.3f},0,0,{yaw_rad:.5f},{size}")
        element.clear()
    (folder / "tracks.csv").write_text("\n".join([HEADER, *rows, ""]), encoding="utf-8")
    return folder / "map.net.xml", folder / "tracks.csv"


@pytest.mark.slow
@pytest.mark.system
def test_demand_of_a_simulation_is_recovered(tmp_path: Path) -> None:
    """Counts, fleet, desired speeds and minimum gap of SUMO's vehicles lie in the stated intervals."""
    network, tracks = simulate(tmp_path)
    new = new_like(tmp_path / "new", network, tracks)
    assert isinstance(new.traffic, TrackDemand)
    assert new.traffic.duration_s == pytest.approx(END_S - WARMUP_S, abs=1.0)
    recorded = {(each.flow.from_edge, each.flow.to_edge): each for each in new.traffic.movements}
    for movement, per_hour in TRUE_FLOWS.items():
        assert recorded[movement].low_per_h <= per_hour <= recorded[movement].high_per_h
        assert recorded[movement].is_usable
    others = [each.vehicles for movement, each in recorded.items() if movement not in TRUE_FLOWS]
    assert sum(others) <= 2
    car, truck = egvs.load(tmp_path / "new").traffic.kinds
    total = sum(each.vehicles for each in new.traffic.movements)
    low, high = intervals.share_interval(round(truck.share * total), total)
    assert low <= TRUCK_SHARE <= high
    assert car.length_m == pytest.approx(4.5, abs=0.01)
    assert car.attributes["minGap"] == pytest.approx(MIN_GAP_M, abs=0.02)

    assert car.attributes["tau"] == pytest.approx(1.0, abs=0.05)

    comments = {estimate.kind.name: " ".join(estimate.comments) for estimate in new.traffic.fleet}
    for name, mean, deviation in (("car", TRUE_SPEED, TRUE_DEVIATION), ("truck", 1.0, 0.05)):
        words = comments[name].partition("speedFactor mean ")[2].split()
        # fast vehicles are free less often: over nine seeds, the mean of cars is 0.004 too low
        assert float(words[2]) - 0.005 <= mean <= float(words[4].rstrip(",")) + 0.005
        words = comments[name].partition("; deviation ")[2].split()
        assert float(words[2]) <= deviation <= float(words[4].rstrip(","))


@pytest.fixture
def karlsruhe() -> Path:
    if not K733.is_dir():
        pytest.skip(f"{K733.name} is not beside the checkout (shared/real)")
    return K733


@pytest.mark.slow
@pytest.mark.system
def test_karlsruhe(tmp_path: Path, karlsruhe: Path) -> None:
    """157 s of 58 vehicles: every movement is marked; the signals repeat a recorded cycle of 88 s."""
    options = NewScenarioOptions(
        like=(karlsruhe / "vehicle_tracks_000.csv.gz",),
        signals=(karlsruhe / "signal_phases_000.csv.gz", karlsruhe / "k733_map.kml.gz"),
    )
    new = create_scenario(tmp_path / "new", karlsruhe / "k733_lanelet2.osm.gz", options=options)
    assert isinstance(new.traffic, TrackDemand)
    assert new.traffic.marked == len(new.traffic.movements)
    vehicles = sum(movement.vehicles for movement in new.traffic.movements)
    assert 50 <= vehicles <= 58
    assert new.traffic.fleet[0].has_default_size
    assert any("The signals repeat a recorded cycle of 88.0 s" in note for note in new.notes)
    network = (tmp_path / "new" / "network.net.xml").read_text(encoding="utf-8")
    phases = [phase.attrib for phase in ElementTree.fromstring(network).iter("phase")]
    assert sum(float(phase["duration"]) for phase in phases) == pytest.approx(88.0)
    shutil.rmtree(tmp_path / "new")
