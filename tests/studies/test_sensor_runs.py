"""``egvs compare --sensors``: one run per sensor in the usual folders, then the comparison of these runs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

import egvs
from egvs.artefacts.run_record import RunRecord
from egvs.core.errors import InputError
from egvs.report.sensor_text import describe_order
from egvs.sensors.sensor import CATALOGUE
from egvs.studies.run_comparison import compare_runs
from egvs.studies.sensor_runs import SensorRun, SensorRuns, prepare_runs, run_sensors


@pytest.fixture
def here(mini: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The small scenario, in the current folder."""
    monkeypatch.chdir(mini.parent)
    return mini.parent


def run_folders(here: Path) -> list[str]:
    return sorted(path.name for path in (here / "runs").iterdir())


@pytest.mark.slow
def test_runs_each_sensor_and_prints_what_compare_prints_for_these_runs(here: Path, run_egvs) -> None:
    code, printed, error = run_egvs("compare", "mini", "--sensors", "small,VLP-16")
    assert code == 0, error
    own, other = run_folders(here)
    assert own == "mini", "all sites have this sensor already"
    assert other.startswith("mini@replace_sensor=VLP-16,")
    own_run, other_run = (RunRecord.read(here / "runs" / name).stages for name in (own, other))
    assert own_run["traffic"].artefacts == other_run["traffic"].artefacts
    assert own_run["tpog"].artefacts == other_run["tpog"].artefacts
    assert own_run["scan"].artefacts != other_run["scan"].artefacts

    lines = error.splitlines()
    assert [line.split()[0] for line in lines[-2:]] == ["small", "VLP-16"]
    assert lines[-1].endswith(f"runs/{other}")
    compared = run_egvs("compare", f"runs/{own}", f"runs/{other}")[1]
    assert printed == compared
    assert "With costs: --set 'costs.sensor={" in printed

    again = run_egvs("compare", "mini", "--sensors", "small,VLP-16")
    assert again[1] == printed
    assert [line.split()[1] for line in again[2].splitlines()[-2:]] == ["unchanged", "unchanged"]


@pytest.mark.slow
def test_settings_go_to_the_runs_and_costs_to_the_comparison(here: Path, run_egvs) -> None:
    settings = ("--set", "effects.range_limit={}", "--set", 'costs.sensor={"VLP-16"=4000, "VLP-32C"=8000}')
    code, printed, error = run_egvs("compare", "mini", "--sensors", "VLP-16,VLP-32C", *settings)
    assert code == 0, error
    folders = run_folders(here)
    assert len(folders) == 2
    assert all(name.startswith("mini@range_limit=on,") for name in folders)
    for name in folders:
        record = RunRecord.read(here / "runs" / name)
        assert "range_limit" in record.scenario["effects"]
        assert not any(key.startswith("costs") for key in record.overrides)
    assert "4,000" in printed
    assert "Losses of returns are not simulated" not in printed


@pytest.mark.slow
def test_range_is_named_as_not_modelled(here: Path, run_egvs) -> None:
    off = ("--set", "effects.range_limit=false")
    for options, count in (((), 0), (off, 1)):
        printed = run_egvs("compare", "mini", "--sensors", "VLP-16,VLP-32C", *options)[1]
        assert printed.count("Losses of returns are not simulated for every sensor") == count
        assert "the interval of the reflectivity, 0.03 to 0.06" in printed


def test_sensors_are_compared_with_losses_also_where_one_needs_none(mini: Path) -> None:
    near, far = prepare_runs(mini, "VLP-16,Livox Tele-15", ["roi.size_m=[30,20,5]"]).runs
    assert near.scenario.effects.range_limit is None
    assert far.scenario.effects.range_limit is not None
    assert "range_limit=on" in far.folder.name
    for off in prepare_runs(mini, "VLP-16,Livox Tele-15", ["effects.range_limit=false"]).runs:
        assert off.scenario.effects.range_limit is False


@pytest.mark.slow
def test_interval_of_reflectivity_is_part_of_the_error(here: Path, run_egvs) -> None:
    """The difference of two sensors, at both ends of the interval, in the runs that differ in nothing else."""
    assert run_egvs("compare", "mini", "--sensors", "VLP-16,OS1-64")[0] == 0
    folders = [folder for folder in (here / "runs").iterdir()]
    sensors = compare_runs(folders).sensors
    assert sensors is not None and sensors.has_loss_interval
    gain = sensors.results[1].gain
    assert gain is not None and gain.se is not None

    scores = []
    for rho in (0.03, 0.06):
        settings = ("--set", f"effects.range_limit.reflectivity={rho}")
        assert run_egvs("compare", "mini", "--sensors", "VLP-16,OS1-64", *settings)[0] == 0
        of_rho = [folder for folder in (here / "runs").iterdir() if f"reflectivity={rho}" in folder.name]
        other = compare_runs(of_rho).sensors
        assert other is not None and not other.has_loss_interval
        assert describe_order(other) == ""
        by_sensor = {result.mount.sensor: result.mount.site.score for result in other.results}
        scores.append(by_sensor["OS1-64"] - by_sensor["VLP-16"])
        if rho == 0.03:
            plain = other.results[1].gain
    assert plain is not None and plain.value == pytest.approx(gain.value)
    expected = math.hypot(plain.se or 0.0, abs(scores[1] - scores[0]) / math.sqrt(3))
    assert gain.se == pytest.approx(expected, rel=1e-6)
    assert gain.se > (plain.se or 0.0)
    assert sensors.order_at_high_reflectivity == other.order
    order = ", ".join(sensors.order)
    assert describe_order(sensors) == f"From 0.03 to 0.06, the order of the sensors stays the same: {order}."
    turned = replace(sensors, order_at_high_reflectivity=tuple(reversed(sensors.order)))
    assert describe_order(turned).endswith(f"; at 0.03, it is {order}.")

    off = prepare_runs(Path("mini"), "VLP-16,OS1-64", ["effects.range_limit=false"]).runs
    for one in off:
        egvs.run(one.scenario, one.folder)
    without = compare_runs([one.folder for one in off]).sensors
    assert without is not None and not without.has_loss_interval and describe_order(without) == ""


def test_run_is_compared_with_its_own_settings(here: Path, mini: Path) -> None:
    egvs.run(egvs.load(mini, ["score.gamma=3"]), here / "finished")
    prepared = prepare_runs(here / "finished", "small,VLP-16")
    own, other = prepared.runs
    assert own.folder == here / "finished"
    assert other.scenario.sites.replace_sensor == "VLP-16"
    assert other.scenario.score.gamma == 3
    assert other.folder.name.startswith("mini@gamma=3,replace_sensor=VLP-16,")
    changed = prepare_runs(here / "finished", "small,VLP-16", ["score.gamma=2"]).runs
    assert changed[0].folder == Path("runs/mini@gamma=2")
    assert [one.scenario.score.gamma for one in changed] == [2, 2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["mini", "--sensors", "VLP-16,OS1-46"], "--sensors: unknown sensor 'OS1-46'. Did you mean OS1-64?"),
        (["mini", "--sensors", "VLP-16"], "--sensors: expected at least two sensors, got VLP-16"),
        (["mini", "--sensors", "VLP-16,small,VLP-16"], "--sensors: VLP-16 is named twice"),
        (["mini", "mini", "--sensors", "VLP-16,small"], "--sensors: expected one scenario or run, got 2"),
        (["mini", "--sensors", "VLP-16,small", "--set", "score.gama=2"], "--set: score.gama: unknown key"),
    ],
)
def test_wrong_request_is_one_message_and_nothing_is_run(
    here: Path, run_egvs, arguments: list[str], message: str
) -> None:
    code, printed, error = run_egvs("compare", *arguments)
    assert (code, printed) == (2, "")
    assert error.splitlines()[0].startswith(f"egvs: {message}")
    assert not (here / "runs").exists()


def test_site_with_a_measured_scan_keeps_its_sensor(mini: Path) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,points\npole_a,10,12,3,scan.pcd\n")
    with pytest.raises(InputError, match="site pole_a has a measured scan"):
        prepare_runs(mini, "small,VLP-16")


def test_all_sensors_are_those_of_the_scenario_and_the_catalogue(mini: Path) -> None:
    prepared = prepare_runs(mini, "all")
    assert [one.sensor for one in prepared.runs] == ["small", *CATALOGUE]
    assert prepared.are_all


def test_says_which_sensors_see_a_part_of_the_circle_where_all_sites_look_east(mini: Path) -> None:
    (note,) = prepare_runs(mini, "VLP-16,AT128,RS-M1").notes
    assert note.startswith("AT128 and RS-M1 do not see the full circle")
    (unrated,) = prepare_runs(mini, "VLP-16,small").notes
    assert unrated.startswith("small has no rated range: its losses of returns are not simulated")
    assert unrated.endswith("Enter rated_range_m and rated_reflectivity under [sensors.small]")
    assert prepare_runs(mini, "VLP-16,AT128", ["sites.yaw_deg=90"]).notes == ()


def test_impossible_sensor_is_left_out_of_all_but_ends_a_chosen_comparison(mini: Path) -> None:
    runs = prepare_runs(mini, "small,VLP-16,VLP-32C").runs
    left_out = []

    def fail(*names: str):
        def run_one(_: int, one: SensorRun) -> None:
            if one.sensor in names:
                raise InputError(one.sensor, "has no rated range")

        return run_one

    def leave_out(one: SensorRun, reason: str) -> None:
        left_out.append((one.sensor, reason))

    every_one, chosen = SensorRuns(runs, are_all=True, notes=()), SensorRuns(runs, are_all=False, notes=())
    finished = run_sensors(every_one, fail("small"), leave_out)
    assert [one.sensor for one in finished] == ["VLP-16", "VLP-32C"]
    assert left_out == [("small", "small: has no rated range")]
    with pytest.raises(InputError, match="small: has no rated range"):
        run_sensors(chosen, fail("small"), leave_out)
    with pytest.raises(InputError, match="small: has no rated range"):
        run_sensors(every_one, fail("small", "VLP-16"), leave_out)
