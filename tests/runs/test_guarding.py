"""What the user made is not written over, and nothing is written through a link."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest

import egvs
from egvs.core import files
from tests.conftest import collection, fcd
from tests.installed import needs


def tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def named(mini: Path, old: str, new: str) -> None:
    path = mini / "scenario.toml"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))


def a_mesh(mini: Path) -> None:
    (mini / "statics.ply").write_text("ply")
    named(mini, "[tpog]", '[[statics.meshes]]\nfile = "statics.ply"\nkind = "wall"\n[tpog]')


def an_fcd_file(mini: Path) -> None:
    (mini / "trajectories.parquet").write_text(fcd())
    named(mini, "fcd.csv", "trajectories.parquet")


def a_file_for_sumo(mini: Path) -> None:
    (mini / "sumo").mkdir()
    (mini / "sumo" / "f.geojson").write_text(collection())
    named(mini, "statics.geojson", "sumo/f.geojson")


def a_measured_scan(mini: Path) -> None:
    (mini / "scan_pole_a.ply").write_text("ply")
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,points\npole_a,10,12,3,scan_pole_a.ply\n")


def a_buffer_of_a_mesh(mini: Path) -> None:
    (mini / "tpog.parquet").write_bytes(b"")
    (mini / "m.gltf").write_text('{"buffers": [{"uri": "tpog.parquet"}]}')
    named(mini, "[tpog]", '[[statics.meshes]]\nfile = "m.gltf"\nkind = "wall"\n[tpog]')


def a_body(mini: Path) -> None:
    (mini / "statics.ply").write_text("ply")
    named(mini, "[tpog]", '[validation.bodies]\nsedan = "statics.ply"\n[tpog]')


INPUTS = {
    "a mesh": (a_mesh, "statics.ply, which the scenario uses (statics.meshes)"),
    "an FCD file": (an_fcd_file, "trajectories.parquet, which the scenario uses (traffic.fcd)"),
    "in the folder of SUMO": (a_file_for_sumo, "sumo/f.geojson, which the scenario uses (statics.footprints)"),
    "a buffer of a mesh": (a_buffer_of_a_mesh, "tpog.parquet, which the scenario uses (statics.meshes)"),
    "a body": (a_body, "statics.ply, which the scenario uses (validation.bodies.sedan)"),
    "a measured scan": (a_measured_scan, "scan_pole_a.ply, which the scenario uses (site pole_a: points)"),
}


@pytest.mark.parametrize(
    "verb", ["run", "statics", "report", "accuracy", pytest.param("validate", marks=needs("validation"))]
)
@pytest.mark.parametrize(("put", "message"), INPUTS.values(), ids=INPUTS.keys())
def test_run_does_not_overwrite_input(mini: Path, run_egvs, put, message: str, verb: str) -> None:
    put(mini)
    before = tree(mini)
    code, _, error = run_egvs(verb, mini, "--out", mini)
    told = f"egvs: --out {mini}: a run would overwrite {message}. Use a separate folder, for example runs/mine.\n"
    assert (code, error) == (2, told)
    assert tree(mini) == before


STUDIES = {
    "accuracy, its results": (("accuracy",), "accuracy/f.csv"),
    "accuracy, its table": (("accuracy",), "accuracy.parquet"),
    "validate, what it keeps": pytest.param(
        ("validate", "--keep"), "validation_kitti/f.csv", marks=needs("validation")
    ),
    "validate, its scores": pytest.param(("validate",), "surrogates.parquet", marks=needs("validation")),
}


@pytest.mark.parametrize(("words", "name"), STUDIES.values(), ids=STUDIES.keys())
def test_study_does_not_overwrite_input(mini: Path, run_egvs, words: tuple[str, ...], name: str) -> None:
    (mini / name).parent.mkdir(exist_ok=True)
    (mini / name).write_text(fcd())
    named(mini, "fcd.csv", name)
    before = tree(mini)
    code, _, error = run_egvs(words[0], mini, "--out", mini, *words[1:])
    assert (code, f"overwrite {name}, which the scenario uses (traffic.fcd)" in error) == (2, True)
    assert tree(mini) == before


@needs("validation")
def test_rejects_input_in_results_folder(mini: Path, tmp_path: Path, run_egvs) -> None:
    theirs = tmp_path / "out" / "validation_kitti"
    theirs.mkdir(parents=True)
    code, _, error = run_egvs("validate", mini, "--out", tmp_path / "out", "--keep", "--detections", theirs)
    assert code == 2
    assert error.startswith(f"egvs: --detections {theirs}: ") and "--keep" in error


FOREIGN = ("statics.ply", "scores.parquet", "tpog.parquet", "report.html", "accuracy.png", "accuracy.sha256",
           "placement.parquet", "sumo/mine.net.xml")  # fmt: skip


@pytest.mark.parametrize(
    "verb", ["run", "statics", "score", "accuracy", pytest.param("validate", marks=needs("validation")), "place"]
)
@pytest.mark.parametrize("name", FOREIGN)
def test_run_does_not_overwrite_file_that_no_run_wrote(
    mini: Path, tmp_path: Path, run_egvs, verb: str, name: str
) -> None:
    out = tmp_path / "mine"
    (out / name).parent.mkdir(parents=True)
    (out / name).write_text("my work of years")
    code, _, error = run_egvs(verb, mini, "--out", out, "--set", "placement.count=1")
    top = name.partition("/")[0]
    hint = f"Use a separate folder, for example runs/mine, or move {top}."
    assert (code, error) == (2, f"egvs: --out {out}: a run would overwrite {top}, which no run wrote. {hint}\n")
    assert tree(out) == {name: b"my work of years"}


def test_run_does_not_overwrite_parquet_file_of_another_program(mini: Path, tmp_path: Path, run_egvs) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table({"mine": [1]}), tmp_path / "scores.parquet")
    code, _, error = run_egvs("run", mini, "--out", tmp_path)
    assert (code, "overwrite scores.parquet, which no run wrote" in error) == (2, True)
    assert pq.read_table(tmp_path / "scores.parquet").column_names == ["mine"]


def test_run_does_not_overwrite_foreign_run_record(mini: Path, tmp_path: Path, run_egvs) -> None:
    (tmp_path / "run.json").write_text('{"speed_km_h": 12}')
    code, _, error = run_egvs("run", mini, "--out", tmp_path)
    assert (code, "run.json: is not a run record" in error) == (2, True)
    assert json.loads((tmp_path / "run.json").read_text()) == {"speed_km_h": 12}


@pytest.mark.slow
def test_run_goes_on_in_the_folder_of_a_killed_or_damaged_run(mini: Path, tmp_path: Path) -> None:
    """Artefacts that no record names, and recorded ones that were damaged, are made again."""
    scenario = egvs.load(mini)
    egvs.run(scenario, tmp_path)
    before = {name: data for name, data in tree(tmp_path).items() if name.endswith((".parquet", ".ply"))}
    (tmp_path / "scores.parquet").write_text("damaged")
    egvs.run(scenario, tmp_path)
    (tmp_path / "run.json").unlink()
    egvs.run(scenario, tmp_path)
    assert {name: tree(tmp_path)[name] for name in before} == before


def test_input_is_recognised_through_link(mini: Path, tmp_path: Path, run_egvs) -> None:
    a_mesh(mini)
    (tmp_path / "link").symlink_to(mini)
    code, _, error = run_egvs("run", mini, "--out", tmp_path / "link")
    assert (code, "overwrite statics.ply" in error) == (2, True)
    (mini / "deep").mkdir()
    (mini / "deep" / "tpog.parquet").write_text("fcd")
    named(mini, "fcd.csv", "deep/tpog.parquet")
    code, _, error = run_egvs("run", mini, "--out", mini / "deep")
    assert (code, "overwrite tpog.parquet, which the scenario uses (traffic.fcd)" in error) == (2, True)


@pytest.mark.slow
def test_run_inside_scenario_folder_is_allowed(mini: Path, run_egvs) -> None:
    before = tree(mini)
    code, _, error = run_egvs("run", mini, "--out", mini)
    assert code == 0, error
    assert {name: tree(mini)[name] for name in before} == before


def test_rejects_lock_that_is_link(mini: Path, tmp_path: Path, run_egvs) -> None:
    (tmp_path / "mine").write_text("kept")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".lock").symlink_to(tmp_path / "mine")
    code, _, error = run_egvs("run", mini, "--out", tmp_path / "out")
    what = "is a symbolic link, and nothing is written through links. Remove it."
    assert (code, error) == (2, f"egvs: {tmp_path / 'out' / '.lock'}: {what}\n")
    assert (tmp_path / "mine").read_text() == "kept"


@pytest.mark.parametrize("place", ["sumo", "sumo/log.txt", "sumo/am"])
def test_rejects_link_in_sumo_folder(mini: Path, tmp_path: Path, run_egvs, place: str) -> None:
    link = tmp_path / "out" / place
    link.parent.mkdir(parents=True)
    link.symlink_to(tmp_path / "elsewhere")
    code, _, error = run_egvs("run", mini, "--out", tmp_path / "out")
    what = "is a symbolic link, and nothing is written through links. Remove it."
    assert (code, error) == (2, f"egvs: {link}: {what}\n")


@needs("validation")
@pytest.mark.parametrize("place", ["validation_kitti", ".validation_kitti.partial", "validation_kitti/pole_a"])
def test_rejects_link_in_detections_folder(mini: Path, tmp_path: Path, run_egvs, place: str) -> None:
    link = tmp_path / "out" / place
    link.parent.mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    link.symlink_to(tmp_path / "elsewhere")
    code, _, error = run_egvs("validate", mini, "--out", tmp_path / "out", "--keep")
    what = "is a symbolic link, and nothing is written through links. Remove it."
    assert (code, error) == (2, f"egvs: {link}: {what}\n")


def test_artefacts_replace_links(mini: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("kept")
    out = tmp_path / "out"
    out.mkdir()
    names = ("statics.ply", "scans.parquet", "trajectories.parquet", "scores.parquet", "report.html", "run.json")
    for name in names[:-1]:
        (out / name).symlink_to(tmp_path / "mine")
    for name in names:
        (out / f".{name}.partial").symlink_to(tmp_path / "mine")
    egvs.run(egvs.load(mini), out)
    assert (tmp_path / "mine").read_text() == "kept"
    assert not [path for path in out.iterdir() if path.is_symlink()]


@pytest.mark.slow
def test_infinite_gamma_round_trips_through_json(mini: Path, tmp_path: Path, run_egvs) -> None:
    def no_constant(name: str) -> float:
        raise AssertionError(f"{name} is no JSON")

    out = tmp_path / "out"
    code, _, error = run_egvs("run", mini, "--out", out, "--set", "score.gamma=inf")
    assert code == 0, error
    record = json.loads((out / "run.json").read_text(), parse_constant=no_constant)
    assert record["scenario"]["score"]["gamma"] == "inf"
    assert run_egvs("verify", out)[0] == 0
    assert "unchanged" in run_egvs("run", mini, "--out", out, "--set", "score.gamma=inf")[2]
    assert json.loads(files.to_json_text({"a": [math.nan, -math.inf, 1.5]}), parse_constant=no_constant) == {
        "a": ["nan", "-inf", 1.5]
    }


NOTHING = {
    "gamma": (
        ["score.gamma=0"],
        "score.gamma: egvs is 0 at every site, so there is no ranking: gamma is 0. Set gamma above 0.",
    ),
    "roi above the traffic": (
        ["roi.center_m=[20,0,42.5]"],
        "roi: egvs is 0 at every site, so there is no ranking: the traffic in the region never changes. "
        "Move or enlarge the region of interest.",
    ),
    "sensors that look up": (
        ["sensors.small.elevations_deg=[60,80]"],
        "sites: egvs is 0 at every site, so there is no ranking: no beam crosses a voxel with traffic. "
        "Check poses, sensors and the region of interest.",
    ),
} | {
    score: (
        ["sensors.small.elevations_deg=[60,80]", f"score.rank_by='{score}'"],
        f"sites: {score} is 0 at every site, so there is no ranking: no beam crosses a voxel with traffic. "
        "Check poses, sensors and the region of interest.",
    )
    for score in ("expected_detections", "seen_well", "points_on_target", "entropy_seen", "coverage")
}


@pytest.mark.parametrize(("settings", "message"), NOTHING.values(), ids=NOTHING.keys())
def test_warns_that_scores_are_zero_at_every_site(mini: Path, tmp_path: Path, run_egvs, settings, message: str) -> None:
    changes = [word for setting in settings for word in ("--set", setting)]
    code, printed, error = run_egvs("run", mini, "--out", tmp_path / "out", *changes)
    assert code == 0, error
    assert f"scenario.toml: {message}" in printed.splitlines()
    assert f"scenario.toml: {message[:60]}" in " ".join(error.split())
    assert not re.search(r"rank +site|best pole", printed + error)
    assert json.loads((tmp_path / "out" / "run.json").read_text())["stages"]["score"]["summary"]["best"] == []


@pytest.mark.slow
def test_names_are_not_taken_for_markup(mini: Path, tmp_path: Path, run_egvs) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\n[red]S1,10,12,3\n[x] :car:,30.5,-12,3\n")
    code, printed, error = run_egvs("run", mini, "--out", tmp_path / "out")
    assert code == 0, error
    assert "[red]S1" in printed


@pytest.mark.slow
def test_warns_of_additional_score_that_is_zero_everywhere(mini: Path, tmp_path: Path, run_egvs) -> None:
    settings = ("--set", "score.rank_by='seen_well'", "--set", "score.gamma=0")
    code, printed, error = run_egvs("run", mini, "--out", tmp_path / "out", *settings)
    assert code == 0, error
    warning = "warning: scenario.toml: score: egvs is 0 at every site, so it does not distinguish them."
    assert f"{warning} Check sites, sensors and effects." in " ".join(error.split())
    assert "\n1  pole_" in printed, "the other score ranks all the same"
    assert "is 0 at every site" not in run_egvs("run", mini, "--out", tmp_path / "two")[2]
