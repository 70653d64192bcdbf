"""Recording traffic: simulated, over TraCI, from finished files; outputs of SUMO."""

import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from egvs.artefacts import parquet
from egvs.core.errors import InputError, RunError
from egvs.core.progress import no_progress
from egvs.effects.base import Traffic
from egvs.scenario.effects_config import EffectParameters
from egvs.scenario.loading import load
from egvs.stages import traffic
from egvs.traffic import network, recording, sumo, sumo_folder, trajectories
from egvs.traffic.vehicle_boxes import ExtraTraffic, VehicleSize
from egvs.world import geolocation
from tests.stage_runner import inputs_of, run_stage
from tests.traffic.helpers import (
    SMALL,
    routes_for,
    scenario,
    scenario_with_options,
    serve,
)


@pytest.mark.slow
def test_seed_determines_the_traffic(town, recorded, tmp_path):
    run_stage(traffic, scenario(town, network="net.xml", **SMALL), tmp_path / "again", jobs=1)
    run_stage(traffic, scenario(town, seed=2, network="net.xml", **SMALL), tmp_path / "other")
    first = (recorded[3] / "trajectories.parquet").read_bytes()
    assert (tmp_path / "again" / "trajectories.parquet").read_bytes() == first
    assert (tmp_path / "other" / "trajectories.parquet").read_bytes() != first


@pytest.mark.slow
def test_moved_folder_reproduces_the_traffic_as_finished_file(recorded, tmp_path):
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


def over_traci(scene, out, folder, *flags):
    process, port = serve(folder, *flags)
    with process:
        try:
            return run_stage(traffic, scene, out, traci=("localhost", port))
        finally:
            process.kill()


@pytest.mark.slow
@pytest.mark.usefixtures("retry_connecting")
def test_recording_over_traci_is_identical(town, recorded, tmp_path):
    result, _, _, out = recorded
    polled = over_traci(scenario(town, network="net.xml", **SMALL), tmp_path, out / "sumo")
    assert (tmp_path / "trajectories.parquet").read_bytes() == (out / "trajectories.parquet").read_bytes()
    assert {k: v for k, v in polled.items() if k not in ("flags", "sumo_seconds", "sumo_peak_mb")} == {
        k: v for k, v in result.items() if k not in ("flags", "sumo_seconds", "sumo_peak_mb")
    }


@pytest.mark.slow
@pytest.mark.usefixtures("retry_connecting")
def test_rejects_running_sumo_with_wrong_step_or_late_clock(town, recorded, tmp_path):
    folder = recorded[3] / "sumo"
    with pytest.raises(InputError, match=r"expected steps of 0\.125 s, got 0\.25 s"):
        over_traci(scenario(town, network="net.xml", **SMALL, step_s=0.125), tmp_path, folder)
    with pytest.raises(RunError, match=r"SUMO is already at 70 s, after the first frame at 60 s"):
        over_traci(scenario(town, network="net.xml", **SMALL), tmp_path, folder, "--begin", "70")
    assert not (tmp_path / "trajectories.parquet").exists()


@pytest.mark.slow
def test_sizes_of_user_routes_come_from_sumo(town, tmp_path):
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


def test_standing_limit_is_two_cycles_or_three_minutes():
    assert recording.standing_limit_s(70) == 180
    assert recording.standing_limit_s(120) == 240


@pytest.mark.slow
def test_progress_reaches_the_end(town, tmp_path):
    reported = []
    run_stage(
        traffic, scenario(town, network="net.xml", **SMALL), tmp_path, progress=lambda *what: reported.append(what)
    )
    assert reported[-1] == ("frames simulated", 240, 240)


def test_last_time_is_that_of_the_last_complete_row(tmp_path):
    path = tmp_path / "fcd.csv"
    assert recording._last_time_ms(path) is None
    path.write_text("timestep_time;vehicle_id\n")
    assert recording._last_time_ms(path) is None
    path.write_text("timestep_time;vehicle_id\n1.250;a\n1.5")
    assert recording._last_time_ms(path) == 1250


COLLISION = '<collision time="{}" lane="{}" collider="{}" victim="{}"{}/>'


def test_collision_warning_names_junctions_and_edges(tmp_path):
    visible = [
        ("9", ":J_1_0", "x", "y", ""), ("10", ":J_1_2_0", "a", "b", ' colliderFront="1,2"'),
        ("11", "out_0", "a", "b", ""), ("12", ":J_1_3_0", "c", "d", ' colliderFront="2,2"'),
        ("13", "out_1", "e", "f", ' colliderFront="325,0,3"'), ("14", "old_1", "g", "h", ""),
    ]  # fmt: skip
    text = "".join(COLLISION.format(*one) for one in visible)
    (tmp_path / sumo_folder.COLLISIONS_FILE).write_text(f"<collisions>{text}</collisions>")
    prepared = SimpleNamespace(folder=tmp_path, timing=SimpleNamespace(first_ms=10_000))
    crashes = recording._read_collisions(prepared)
    assert len(crashes) == 4
    (result,) = recording._collision_warning(crashes, scenario(tmp_path, network="net.xml"))
    assert result.problem == (
        "4 pairs of vehicles collided and drove through each other: 2 at junction J_1 (in the region of interest), "
        "1 at edge out (300 m from the region of interest), 1 at edge old"
    )
    assert recording._collision_warning({}, scenario(tmp_path, network="net.xml")) == []


@pytest.mark.slow
def test_warns_about_vehicles_that_could_not_start(town, tmp_path):
    """Six hundred cars an hour too many for one street."""
    roads = network.read_net_xml(town / "net.xml")
    way_in = next(edge for edge in roads.edges if edge.from_node.startswith("left"))
    flow = f'<flow id="f" begin="0" end="100" number="900" from="{way_in.id}" to="{way_in.id}"/>'
    (tmp_path / "own.rou.xml").write_text(f"<routes>{flow}</routes>")
    keys = {"network": str(town / "net.xml"), "routes": ["own.rou.xml"], "frames": 60, "warmup_s": 10.0}
    result = run_stage(traffic, scenario(tmp_path, **keys), tmp_path / "out")
    results = [warning for warning in result["warnings"] if warning["rule"] == "waiting"]
    assert len(results) == 1 and "vehicles could not start" in results[0]["problem"]
    assert not (tmp_path / "out" / "sumo" / "statistics.xml").exists()


@pytest.mark.slow
@pytest.mark.parametrize("blocks", [0, 8])
def test_reports_full_disk(town, tmp_path, monkeypatch, blocks):
    """A limit on file size has the effect of a full disk: SUMO ends with exit code 0."""
    limited = tmp_path / "sumo-limited"
    limited.write_text(f"#!/bin/sh\ntrap '' XFSZ\nulimit -f {blocks}\n{sumo.sumo_binary('sumo')} \"$@\"\nexit 0\n")
    limited.chmod(0o755)
    monkeypatch.setenv("SUMO_BINARY", str(limited))
    with pytest.raises(RunError, match=r"fcd\.csv: SUMO wrote an incomplete file. Is the disk full\? \([\d,]+ MB"):
        run_stage(traffic, scenario(town, network="net.xml", **SMALL), tmp_path / "out")


def cut_to_rows(path):
    text = path.read_text().splitlines(keepends=True)
    path.write_text("".join(text[: len(text) // 2]))


def cut_amid_a_row(path):
    path.write_text(path.read_text()[:-9])


def empty(path):
    path.write_bytes(b"")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("fcd.csv", cut_to_rows), ("fcd.csv", cut_amid_a_row), ("fcd.csv", empty), ("statistics.xml", cut_to_rows),
        ("statistics.xml", empty), ("collisions.xml", cut_amid_a_row),
    ],
)  # fmt: skip
def test_rejects_truncated_output(demand_folder, tmp_path, monkeypatch, name, damage):
    damage_output(monkeypatch, name, damage)
    with pytest.raises(RunError, match=f"{name}: SUMO wrote an incomplete file"):
        run_stage(traffic, scenario_with_options(demand_folder), tmp_path / "out")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hold", "message"),
    [
        ("at_most", r"fcd\.csv: SUMO wrote an incomplete file"),
        ("exactly", r"expected 12 vehicles in every frame, got them in 1\d\d of 240 frames"),
    ],
)
def test_rejects_missing_frames_at_the_end(town, tmp_path, monkeypatch, hold, message):
    damage_output(monkeypatch, "fcd.csv", cut_to_rows)
    with pytest.raises(RunError, match=message):
        run_stage(traffic, scenario(town, network="net.xml", hold=hold, **SMALL), tmp_path / "out")


def damage_output(monkeypatch, name, damage):
    """Damage an output as soon as SUMO has ended, and read it then."""
    run, record = sumo.run_program, recording.record_traffic
    monkeypatch.setattr(recording, "record_traffic", lambda *rest, live, **more: record(*rest, **more))

    def cut(program, arguments, folder, *more):
        printed = run(program, arguments, folder, *more)
        damage(folder / name)
        return printed

    monkeypatch.setattr(sumo, "run_program", cut)


TRAM = VehicleSize(30.0, 2.4, 3.5, "tram")


class Raised:
    """Lifts every box, and counts them."""

    def __init__(self, sizes):
        self.sizes, self.boxes = sizes, 0

    def change(self, boxes):
        self.boxes += boxes.frame.size
        return replace(boxes, z_m=boxes.z_m + 100.0)

    def summary(self):
        return {"raised": self.boxes, "kinds": sorted(self.sizes)}


class Guests(Traffic):
    """One more vehicle, which does not count, and boxes that are lifted."""

    NAME = "guests"
    ADDS_TRAFFIC = True

    def sizes(self):
        return {"guest": TRAM}

    def uncounted_types(self, sizes):
        return frozenset({"guest"})

    def plan(self, scenario, roads, begin_s, end_s, rng):
        lane = next(edge for edge in roads.edges if edge.lanes_for("passenger"))
        vtype = '<vType id="guest" vClass="passenger" length="30" width="2.4" height="3.5"/>'
        stop = f'<stop edge="{lane.id}" duration="9999" parking="true"/>'
        guest = f'<trip id="guest" type="guest" depart="0" from="{lane.id}" to="{lane.id}">{stop}</trip>'
        return ExtraTraffic(f"<routes>{vtype}{guest}</routes>", 1, (f"a guest from {begin_s:g} to {end_s:g} s",))

    def box_change(self, scenario, sizes):
        return Raised(sizes)


def record_scene(scene, out, *acting):
    with (
        recording.record_traffic(
            scene, out / "sumo", acting, no_progress, None, geolocation.scenario_georeference(scene)
        ) as rows,
        parquet.artefact_writer(out / "trajectories.parquet", "trajectories") as file,
    ):
        tally, reports = trajectories.write_trajectories(scene, rows, acting, file, no_progress)
        file.describe({"schema": 1, "frames": 1})
        return tally.to_json(rows.window.period_ms / 1000.0), reports, rows.summary()


@pytest.mark.slow
def test_extension_adds_uncounted_traffic_and_changes_boxes(town, tmp_path):
    scene = scenario(town, network="net.xml", **SMALL)
    counts, reports, summary = record_scene(scene, tmp_path, Guests(EffectParameters()))
    plain = run_stage(traffic, scene, tmp_path / "plain")
    assert (counts["vehicles"]["fewest"], counts["vehicles"]["most"]) == (12, 12)
    extra = counts["beside_vehicles"]
    assert set(extra) == {"tram", "overlapping_pairs"} and extra["tram"]["most"] == 1
    assert reports["kinds"] == sorted({"car", "van", "truck", "bus"})
    assert reports["raised"] == plain["rows"] + extra["tram"]["mean"] * 240
    assert summary.notes == ["a guest from 0 to 120 s"]
    flags = " ".join(summary.flags)
    assert "trips.rou.xml,others.rou.xml" in flags and "--max-num-vehicles 13" in flags


@pytest.mark.slow
def test_two_extensions_add_route_files_and_change_boxes_in_order(town, tmp_path):
    class Others(Guests):
        def plan(self, *arguments):
            return ExtraTraffic("<routes/>", 0)

    scene = scenario(town, network="net.xml", **SMALL)
    counts, _, summary = record_scene(scene, tmp_path, Guests(EffectParameters()), Others(EffectParameters()))
    flags = " ".join(summary.flags)
    assert "trips.rou.xml,others.rou.xml,others1.rou.xml" in flags and "--max-num-vehicles 13" in flags
    assert counts["vehicles"]["most"] == 12
    lifted = parquet.read_artefact(tmp_path / "trajectories.parquet", "trajectories")[0]["z_m"].to_numpy()
    assert lifted.min() > 200 and lifted.max() < 202


def test_error_of_an_extension_is_raised_before_the_folder_is_prepared(town, tmp_path):
    class Choosy(Guests):
        def scenario_error(self, scenario):
            return InputError("guests", "this is no place for guests", "Use another place.")

    with pytest.raises(InputError, match="no place for guests"):
        record_scene(scenario(town, network="net.xml", **SMALL), tmp_path, Choosy(EffectParameters()))
    assert not (tmp_path / "sumo").exists()


ROUNDABOUT = Path(__file__).resolve().parents[2] / "scenarios" / "roundabout"


def test_roundabout_sources_give_the_committed_network(tmp_path):
    for source in (ROUNDABOUT / "network").iterdir():
        shutil.copy(source, tmp_path)
    words = (ROUNDABOUT / "network" / "README.md").read_text().partition("    netconvert ")[2].partition("\n\n")[0]
    arguments = words.replace("\\", " ").replace("../network.net.xml", "made.net.xml").split()
    sumo.run_program("netconvert", arguments, tmp_path)
    made = [
        re.sub(r"<!--.*?-->", "", text, flags=re.S).split()
        for text in ((tmp_path / "made.net.xml").read_text(), (ROUNDABOUT / "network.net.xml").read_text())
    ]
    assert made[0] == made[1]


@pytest.mark.slow
def test_roundabout_traffic_is_constant_and_counter_clockwise(tmp_path):
    scene = load(ROUNDABOUT, ["traffic.frames=120", "traffic.warmup_s=100", "tpog.blocks=1"])
    result = run_stage(traffic, scene, tmp_path)
    assert result["vehicles"]["fewest"] == result["vehicles"]["most"] == 28 and result["collisions"] == 0
    rows = parquet.read_artefact(tmp_path / "trajectories.parquet", "trajectories")[0]
    x, y, yaw = (rows[name].to_numpy() for name in ("x_m", "y_m", "yaw_rad"))
    from_middle_m = np.hypot(x, y)
    assert from_middle_m.min() > 14  # nobody on the island
    circling = from_middle_m < 18
    assert circling.sum() > 200
    counter_clockwise = x * np.sin(yaw) - y * np.cos(yaw) > 0  # right-hand traffic
    assert counter_clockwise[circling].all()
