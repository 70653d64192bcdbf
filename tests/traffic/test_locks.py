"""Locks: vehicles that SUMO moved on, and a region that is locked while SUMO runs."""

import re

import pytest

from egvs.core.errors import RunError
from egvs.core.grid import Roi
from egvs.stages import traffic
from egvs.traffic import locks, network, sumo_folder
from egvs.traffic.locks import DemandKey, RegionWatch, StreetNames, WatchedRegion
from egvs.traffic.sumo_folder import Timing
from tests.stage_runner import run_stage
from tests.traffic.helpers import SIZES, netgenerate, scenario

ROI = Roi.around((0, 0, 2.5), (50, 100, 5))
DEMAND = DemandKey("s.toml: traffic.counts", "Lower per_hour.")

NET = """<net version="1.20">
  <edge id=":j_0" function="internal"><lane id=":j_0_0" index="0" speed="9" length="9" shape="0,0 3,0"/></edge>
  <edge id="in" from="a" to="j" name="Main Street"><lane id="in_0" index="0" shape="-100,0 0,0"/></edge>
  <edge id="out" from="j" to="b"><lane id="out_0" index="0" shape="3,0 300,0"/></edge>
  <connection from="in" to="out" fromLane="0" toLane="0" via=":j_0_0" dir="s" state="o"/>
</net>
"""
LOG = """Warning: Teleporting vehicle 'a'; waited too long (jam), lane='in_0', time=90.00.
Warning: Vehicle 'a' ends teleporting on edge 'out', time=91.00.
Warning: Teleporting vehicle 'b'; waited too long (yield), lane='in_0', time=100.00.
Warning: Teleporting vehicle 'c'; waited too long (wrong lane), lane='out_0', time=400.50.
Warning: Teleporting vehicle 'd'; waited too long (yield), lane='in_0', time=500.00.
"""
HEADER = "timestep_time;vehicle_angle;vehicle_id;vehicle_speed;vehicle_type;vehicle_x;vehicle_y\n"


@pytest.fixture
def roads(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(NET)
    return network.read_net_xml(path)


def rows(seconds, *vehicles):
    """FCD of every second: vehicles (name, x, y, angle) stand, those with a speed drive east."""
    lines = []
    for second in seconds:
        for name, x, y, angle, *speed in vehicles:
            at = x + second * sum(speed)
            lines.append(f"{second:.3f};{angle:.2f};{name};{sum(speed):.2f};car;{at:.2f};{y:.2f}\n")
    return HEADER + "".join(lines)


def watch(tmp_path, roads, regions=None, teleport_s=None):
    timing = Timing(0, 0, 1000, 250, 2000)
    fcd, log = tmp_path / "fcd.csv", tmp_path / "sumo.log"
    return RegionWatch(fcd, log, timing, regions or {"": WatchedRegion(ROI)}, roads, SIZES, DEMAND, teleport_s)


def test_reads_teleports_of_recorded_time():
    result = locks.read_teleports(LOG, 100.0)
    assert [(t.vehicle, t.reason, t.lane, t.time_s) for t in result] == [
        ("b", "yield", "in_0", 100.0), ("c", "wrong lane", "out_0", 400.5), ("d", "yield", "in_0", 500.0),
    ]  # fmt: skip


def test_locations_are_named_by_junction_and_street(roads):
    names = StreetNames(roads)
    assert names.of_lane("in_0") == "junction j, Main Street"
    assert names.of_lane("out_0") == "junction b, edge out"
    assert names.of_lane(":j_0_0") == "junction j, edge :j_0"
    assert names.of_lane("old_0") == "lane old_0" and names.end_of_lane("old_0") is None
    assert names.at((-50.0, 2.0)) == "junction j, Main Street"


def test_warning_names_junction_street_times_and_share(roads):
    teleports = locks.read_teleports(LOG, 100.0)
    (result,) = locks.teleport_warning(teleports, 300, 180.0, StreetNames(roads), ROI, DEMAND)
    assert result.rule == "teleports" and not result.is_error and result.where == "s.toml: traffic.counts"
    assert result.problem == (
        "3 of 300 vehicles (1.0 %) stood at the head of their lane for 180 s and were moved on:"
        " 2 at junction j, Main Street (100 to 500 s, x 0 m, y 0 m, in the region of interest);"
        " 1 at junction b, edge out (400 s, x 300 m, y 0 m, 275 m from the region of interest)"
    )
    assert locks.teleport_warning([], 300, 180.0, StreetNames(roads), ROI, DEMAND) == []


def test_region_is_locked_when_a_vehicle_stands_with_free_road_ahead(tmp_path, roads):
    (tmp_path / "fcd.csv").write_text(rows(range(400), ("stuck", -10, 0, 90), ("goes", 0, 30, 90, 0.5)))
    with pytest.raises(RunError) as caught:
        watch(tmp_path, roads).finish()
    assert str(caught.value) == (
        "s.toml: traffic.counts: the traffic in the region of interest is locked: vehicle 'stuck' stood at junction j,"
        " Main Street (x -10 m, y 0 m) from 0 s to 180 s. Lower per_hour."
    )


@pytest.mark.parametrize(
    ("vehicles", "seconds"),
    [
        ([("stuck", -10, 0, 90)], 180),
        ([("far", -40, 0, 90)], 1000),
        ([("second", 20, 0, 90), ("first", 27, 0, 90)], 360),
        ([("slow", -20, 0, 90, 0.05)], 900),
    ],
    ids=["briefly", "outside the region", "behind a vehicle outside", "slowly"],
)
def test_region_is_not_locked(tmp_path, roads, vehicles, seconds):
    (tmp_path / "fcd.csv").write_text(rows(range(seconds), *vehicles))
    watch(tmp_path, roads).finish()


def test_vehicle_behind_another_is_locked_after_twice_the_time(tmp_path, roads):
    """The first of both is outside the region."""
    (tmp_path / "fcd.csv").write_text(rows(range(700), ("second", 20, 0, 90), ("first", 27, 0, 90)))
    with pytest.raises(RunError, match=r"'second' stood at .* from 0 s to 360 s"):
        watch(tmp_path, roads).finish()


def test_circle_of_vehicles_is_locked(tmp_path, roads):
    """Each of four vehicles waits for the one ahead; none has free road."""
    circle = [("e", -2, -3, 90), ("n", 3, -2, 0), ("w", 2, 3, 270), ("s", -3, 2, 180)]
    (tmp_path / "fcd.csv").write_text(rows(range(181), *circle))
    with pytest.raises(RunError, match=r"stood at .* from 0 s to 180 s"):
        watch(tmp_path, roads).finish()


@pytest.fixture
def signal(tmp_path):
    """The road with a signal that is red for 170 s of 200 s."""
    path = tmp_path / "signal.net.xml"
    program = """<tlLogic id="j" type="actuated" programID="0" offset="0">
    <phase duration="30" minDur="5" maxDur="30" state="G"/><phase duration="5" state="y"/>
    <phase duration="60" minDur="5" maxDur="165" state="r"/></tlLogic>
  <connection"""
    path.write_text(NET.replace("<connection", program).replace('dir="s"', 'dir="s" tl="j" linkIndex="0"'))
    return network.read_net_xml(path)


def test_vehicle_at_red_signal_is_not_locked(tmp_path, signal):
    """At the stop line, the red phase and a margin come first; 60 s later the vehicle is locked."""
    assert signal.red_s == 170.0
    (tmp_path / "fcd.csv").write_text(rows(range(240), ("stuck", -1, 0, 90)))
    watch(tmp_path, signal).finish()
    (tmp_path / "fcd.csv").write_text(rows(range(300), ("stuck", -1, 0, 90)))
    with pytest.raises(RunError, match="from 0 s to 250 s"):
        watch(tmp_path, signal).finish()
    (tmp_path / "fcd.csv").write_text(rows(range(300), ("elsewhere", -20, 0, 90)))
    with pytest.raises(RunError, match="from 0 s to 180 s"):
        watch(tmp_path, signal).finish()


def test_region_is_refused_only_after_sumo_should_have_moved_the_vehicle_on(tmp_path, roads):
    (tmp_path / "fcd.csv").write_text(rows(range(400), ("stuck", -10, 0, 90)))
    with pytest.raises(RunError, match="from 0 s to 300 s"):
        watch(tmp_path, roads, teleport_s=240.0).finish()


def test_rescue_waits_for_the_longest_red_phase(roads, signal):
    assert sumo_folder.rescue_s(120.0, roads) == 120.0
    assert sumo_folder.rescue_s(120.0, signal) == 185.0
    assert sumo_folder.rescue_s(200.0, signal) == 200.0
    assert sumo_folder.rescue_s(None, signal) is None


REGIONS = {
    "west": WatchedRegion(ROI, near=Roi.around((0, 0, 2.5), (100, 100, 5))),
    "east": WatchedRegion(Roi.around((200, 0, 2.5), (50, 100, 5)), near=Roi.around((200, 0, 2.5), (100, 100, 5))),
}


def test_locked_region_is_listed_and_others_go_on(tmp_path, roads):
    (tmp_path / "fcd.csv").write_text(rows(range(300), ("stuck", -10, 0, 90), ("goes", 0, 30, 90, 0.5)))
    watched = watch(tmp_path, roads, REGIONS)
    watched.finish()
    assert watched.locked == {
        "west": "vehicle 'stuck' stood at junction j, Main Street (x -10 m, y 0 m) from 0 s to 180 s"
    }
    (tmp_path / "fcd.csv").write_text(rows(range(300), ("stuck", -10, 0, 90), ("too", 200, 0, 90)))
    with pytest.raises(RunError, match=r"in all 2 regions of interest is locked: west: vehicle 'stuck' .*; east: "):
        watch(tmp_path, roads, REGIONS).finish()


@pytest.mark.slow
def test_share_that_is_moved_on_is_of_vehicles_near_the_region(tmp_path, roads):
    lines = [
        f"Warning: Teleporting vehicle 'v{i}'; waited too long (jam), lane='in_0', time={10 * i}.00."
        for i in range(1, 12)
    ]
    (tmp_path / "sumo.log").write_text("\n".join(lines) + "\n")
    far = [(f"far{i}", 1000, 3 * i, 90, 5) for i in range(1000)]
    (tmp_path / "fcd.csv").write_text(rows(range(0, 300, 10), *((f"v{i}", -20, i, 90, 0.5) for i in range(40)), *far))
    watched = watch(tmp_path, roads, REGIONS)
    watched.finish()
    assert list(watched.locked) == ["west"]
    assert watched.locked["west"].startswith("10 of 40 vehicles had to be moved on by 100 s, 10 of them at junction j")


def test_decision_does_not_depend_on_when_files_are_read(tmp_path, roads):
    text = rows(range(400), ("stuck", -10, 0, 90))
    messages = []
    for step in (7, 1000, len(text)):
        watched = watch(tmp_path, roads)
        with pytest.raises(RunError) as caught:
            for end in range(0, len(text) + step, step):
                (tmp_path / "fcd.csv").write_text(text[:end])
                watched.update()
            watched.finish()
        messages.append(str(caught.value))
    assert len(set(messages)) == 1


@pytest.mark.slow
def test_region_is_locked_when_too_many_vehicles_are_moved_on(tmp_path, roads):
    """One in ten seconds: the tenth, at 100 s, is the first that is refused."""
    lines = [
        f"Warning: Teleporting vehicle 'v{i}'; waited too long (jam), lane='in_0', time={10 * i}.00."
        for i in range(1, 30)
    ]
    (tmp_path / "sumo.log").write_text("\n".join(lines) + "\n")
    (tmp_path / "fcd.csv").write_text(rows(range(300), *((f"v{i}", -100, 3 * i, 90, 5) for i in range(50))))
    message = (
        r"10 of 50 vehicles had to be moved on by 100 s, 10 of them at junction j, Main Street \(x 0 m, y 0 m\), the"
        r" first at 10 s"
    )
    with pytest.raises(RunError, match=message):
        watch(tmp_path, roads).finish()
    (tmp_path / "fcd.csv").write_text(rows(range(300), *((f"v{i}", -100, 3 * i, 90, 5) for i in range(1000))))
    watch(tmp_path, roads).finish()  # 2.9 % of the vehicles


# --- with SUMO -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def locked(tmp_path_factory):
    """A crossing of four streets whose signals stay red for good."""
    folder = tmp_path_factory.mktemp("locked")
    path = netgenerate(folder, "--grid", "--grid.number", "1", "--grid.attach-length", "150", "--no-turnarounds",
                       "--default-junction-type", "traffic_light", "--offset.disable-normalization")  # fmt: skip
    text = path.read_text()
    head, _, rest = text.partition("<tlLogic")
    program, _, tail = rest.partition("</tlLogic>")
    states = program.split('state="')[1].split('"')[0]
    red = f' id="A0" type="static" programID="0" offset="0"><phase duration="60" state="{"r" * len(states)}"/>'
    path.write_text(f"{head}<tlLogic{red}</tlLogic>{tail}")
    return folder


def locked_scenario(folder, center, per_hour=300, **keys):
    counts = [{"from_edge": "left0A0", "to_edge": "A0right0", "per_hour": per_hour}]
    keys = {"frames": 3000, "warmup_s": 30.0, "frame_period_s": 1.0, "step_s": 1.0} | keys
    model = scenario(folder, network="net.xml", counts=counts, **keys)
    return model.model_copy(update={"roi": model.roi.model_copy(update={"center_m": center})})


@pytest.mark.slow
def test_locked_region_is_refused_while_sumo_runs(locked, tmp_path):
    reported = []
    with pytest.raises(
        RunError,
        match=r"traffic\.counts: the traffic in the region of interest is locked: vehicle .* stood at junction A0",
    ):
        run_stage(
            traffic,
            locked_scenario(locked, (150.0, 150.0, 2.5)),
            tmp_path,
            progress=lambda *what: reported.append(what),
        )
    assert not (tmp_path / "trajectories.parquet").exists()


@pytest.mark.slow
def test_long_red_phase_is_no_lock_and_needs_no_rescue(locked, tmp_path):
    """A signal that is red for 170 s of 200 s: rescue waits for green, and nobody is moved on."""
    text = (locked / "net.xml").read_text()
    head, _, rest = text.partition('<phase duration="60"')
    state = rest.split('state="')[1].split('"')[0]
    phases = f'<phase duration="30" state="{"G" * len(state)}"/><phase duration="170"'
    (tmp_path / "net.xml").write_text(head + phases + rest)
    keys = {"per_hour": 60, "frames": 1500, "teleport_s": 120}
    result = run_stage(traffic, locked_scenario(tmp_path, (150.0, 150.0, 2.5), **keys), tmp_path / "out")
    assert result["teleports"] == 0
    assert 120 < result["longest_standing_s"] <= 175
    assert "teleport_s: vehicles are moved on after 185 s, because a signal is red for 170 s" in result["notes"]


@pytest.mark.slow
def test_lock_far_from_region_is_a_warning(locked, tmp_path):
    result = run_stage(traffic, locked_scenario(locked, (30.0, 150.0, 2.5), per_hour=60, frames=400), tmp_path)
    (warning,) = [warning for warning in result["warnings"] if warning["rule"] == "standing"]
    assert re.search(
        r", at junction A0, edge left0A0, x \d+ m, y \d+ m \(\d+ m from the region of interest\), from \d+ s on; "
        r"\d of \d vehicles \(\d+\.\d %\) stood",
        warning["problem"],
    )


@pytest.mark.slow
def test_vehicles_are_moved_on_and_counted(locked, tmp_path):
    scene = locked_scenario(locked, (30.0, 150.0, 2.5), per_hour=60, frames=1000, teleport_s=120)
    result = run_stage(traffic, scene, tmp_path / "a")
    (warning,) = [warning for warning in result["warnings"] if warning["rule"] == "teleports"]
    assert result["teleports"] > 3
    assert "stood at the head of their lane for 120 s and were moved on" in warning["problem"]
    assert "at junction A0, edge left0A0" in warning["problem"]
    run_stage(traffic, scene, tmp_path / "b")
    files = [(tmp_path / run / "trajectories.parquet").read_bytes() for run in "ab"]
    assert files[0] == files[1]
