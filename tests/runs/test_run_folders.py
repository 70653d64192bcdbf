"""Each set of settings has a run folder; runs are listed; commands accept a run and use its settings."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

import egvs
from egvs.artefacts import checksums
from egvs.artefacts.checksums import add_checksum
from egvs.artefacts.run_folder import STAGE_NAMES, RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.cli import run_list_table
from egvs.core import files
from egvs.core.errors import InputError, RunError
from egvs.runs import locks, run_list, run_sources
from egvs.runs.run import lock_run_folder
from egvs.runs.run_sources import SettingsSource
from egvs.scenario.settings import format_overrides
from tests.installed import needs

OTHER = Path("runs/mini@gamma=5")


@pytest.fixture
def here(mini: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The scenario ``mini`` in the working folder."""
    monkeypatch.chdir(mini.parent)
    return Path("mini")


def make_later(folder: Path, seconds: float) -> None:
    """Make a run later than it was."""
    path = RunFolder(folder).lock
    os.utime(path, (path.stat().st_atime + seconds, path.stat().st_mtime + seconds))


def digests(folder: Path) -> dict[str, str]:
    return {path.name: files.hash_file(path) for path in folder.glob("*.parquet")}


@pytest.mark.slow
def test_run_with_overrides_leaves_the_run_as_written(here: Path, run_egvs: Any) -> None:
    assert run_egvs("run", here)[0] == 0
    before = digests(Path("runs/mini"))
    code, printed, _ = run_egvs("run", here, "--set", "score.gamma=5")
    assert (code, "report: runs/mini@gamma=5/report.html" in printed) == (0, True)
    assert digests(Path("runs/mini")) == before
    assert digests(OTHER)["scores.parquet"] != before["scores.parquet"]
    assert RunRecord.read(OTHER).overrides == {"score.gamma": 5.0}
    assert RunRecord.read(Path("runs/mini")).overrides == {}
    assert sorted(path.name for path in Path("runs").iterdir()) == ["mini", "mini@gamma=5"]


@pytest.mark.slow
def test_stage_with_overrides_restores_the_stages_before_it(here: Path, run_egvs: Any) -> None:
    egvs.run(egvs.load(here))
    code, printed, messages = run_egvs("score", here, "--set", "score.gamma=5")
    assert (code, str(OTHER / "scores.parquet") in printed) == (0, True)
    restored = [line.split()[0] for line in messages.splitlines() if "from store" in line]
    assert restored == ["statics", "scan", "traffic", "occupancy"]
    assert list(RunRecord.read(OTHER).stages) == ["statics", "scan", "traffic", "tpog", "score"]
    egvs.run(egvs.load(here, ["score.gamma=5"]), "fresh")
    assert digests(OTHER) == digests(Path("fresh"))


def test_first_stage_restores_nothing(here: Path, run_egvs: Any) -> None:
    egvs.run(egvs.load(here))
    assert run_egvs("traffic", here, "--set", "score.gamma=5")[0] == 0
    assert list(RunRecord.read(OTHER).stages) == ["traffic"]


def test_stage_without_the_stages_before_it_names_the_missing_file(
    here: Path, run_egvs: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    egvs.run(egvs.load(here))
    monkeypatch.setenv("EGVS_STORE", "")
    code, _, message = run_egvs("score", here, "--set", "score.gamma=5")
    assert code == 2
    assert message == f"egvs: {OTHER}/statics.ply: no such file. Run the stage that writes statics.ply first.\n"


# ---- egvs runs


@pytest.mark.slow
def test_lists_runs_latest_first_with_what_differs_and_the_best_site(here: Path, run_egvs: Any) -> None:
    egvs.run(egvs.load(here))
    egvs.run(egvs.load(here, ["score.gamma=5", "traffic.frames=20"]))
    make_later(Path("runs/mini@frames=20,gamma=5"), 60)
    code, printed, _ = run_egvs("runs")
    head, latest, plain, hint = printed.splitlines()
    assert code == 0
    assert head.split() == ["run", "state", "best", "score", "size", "last", "run"]
    assert latest.split()[:2] == ["mini@frames=20,gamma=5", "complete"]
    assert "--verbose" in hint
    scores = egvs.read_scores("runs/mini/scores.parquet").to_pylist()
    best = max(scores, key=lambda row: row["egvs"])
    assert plain.split()[:6] == ["mini", "complete", best["site"], f"{best['egvs']:,.0f}", "EGVS", "bit"]
    paragraphs = [text.splitlines() for text in run_egvs("runs", "--verbose")[1].split("\n\n")]
    assert [lines[0] for lines in paragraphs] == ["runs/mini@frames=20,gamma=5", "runs/mini"]
    assert paragraphs[0][1:4] == [
        "  scenario    mini",
        "  differs in  score.gamma=5, traffic.frames=20",
        "  state       complete",
    ]
    assert paragraphs[1][3:6] == [
        f"  best        {best['site']}",
        f"  score       {best['egvs']:,.0f} EGVS bit",
        "  sites       2",
    ]
    make_later(Path("runs/mini"), 120)
    assert [run.folder.name for run in run_list.list_runs()] == ["mini", "mini@frames=20,gamma=5"]


@pytest.mark.parametrize("width", [60, 80, 100, 140, 190])
def test_list_fits_the_terminal_and_cuts_no_number(width: int) -> None:
    """Names continue on the next line; numbers stay whole."""
    label = "what_if.works.boxes.0.height_m=3.25,tall,32737403"
    best = run_list.BestSites("egvs", tuple(f"kerb_NE{i}@4.5m+aim" for i in range(5)), 1_234_567.0, 108)
    overrides = {"what_if.works.boxes.0.height_m": 3.25, "sites.sensor": "VLP-32C"}
    runs = [
        run_list.ListedRun(Path(f"runs/nishishinjuku@{label}"), 0.0, 109_000_000, Path("s"), overrides, best=best),
        run_list.ListedRun(Path("runs/bh"), 0.0, 2_500, Path("s"), missing=("report",), best=best),
    ]
    text = io.StringIO()
    Console(file=text, width=width).print(run_list_table.runs_table(runs, width, now_s=7_200.0))
    lines = text.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    assert "…" not in text.getvalue()
    for number in ("1,234,567 EGVS bit", "109 MB", "2.5 KB", "2 h ago"):
        assert any(number in line for line in lines), number
    if width <= run_list_table.FILE_WIDTH:
        name = "".join(line[: lines[0].index("state")].strip() for line in lines[1:])
        assert name.startswith(runs[0].folder.name)
    assert ("differs in" in lines[0]) == (width >= 140)


@pytest.mark.slow
def test_repeated_run_is_the_latest_although_no_stage_ran(here: Path) -> None:
    egvs.run(egvs.load(here))
    egvs.run(egvs.load(here, ["score.gamma=5"]))
    make_later(Path("runs/mini"), -60)
    assert run_list.list_runs()[0].folder == OTHER
    make_later(OTHER, -60)
    egvs.run(egvs.load(here))
    assert run_list.list_runs()[0].folder == Path("runs/mini")


def test_list_reads_sizes_and_missing_stages(here: Path, run_egvs: Any) -> None:
    assert run_egvs("statics", here)[0] == 0
    (listed,) = run_list.list_runs()
    assert listed.missing == tuple(name for name in STAGE_NAMES if name != "statics")
    assert listed.best is None
    assert listed.size_bytes == sum(path.stat().st_size for path in Path("runs/mini").rglob("*"))
    assert "without check, scan" in run_egvs("runs")[1]


BROKEN = {
    "damaged record": ("run.json", "{", "run.json: is not valid JSON"),
    "changed record": ("run.json", None, "run.json: was changed after the run"),
    "damaged scores": ("scores.parquet", "x", "scores.parquet: "),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "content", "problem"), BROKEN.values(), ids=BROKEN)
def test_lists_broken_runs_with_their_problem(
    here: Path, run_egvs: Any, name: str, content: str | None, problem: str
) -> None:
    egvs.run(egvs.load(here))
    egvs.run(egvs.load(here, ["score.gamma=5"]))
    path = OTHER / name
    path.write_text(path.read_text().replace('"seed": 7', '"seed": 8', 1) if content is None else content)
    code, printed, message = run_egvs("runs")
    assert (code, message) == (0, "")
    lines = {line.split()[0]: line for line in printed.splitlines()}
    assert problem in lines[OTHER.name]
    assert "complete" in lines["mini"]


def test_lists_interrupted_run_and_no_other_folder(here: Path) -> None:
    for name in ("stopped", "unused", "notes", ".store"):
        (Path("runs") / name).mkdir(parents=True)
    for name in ("stopped", "unused", ".store"):
        (Path("runs") / name / ".lock").touch()
    (Path("runs") / "stopped" / "statics.ply").touch()
    (listed,) = run_list.list_runs()
    assert (listed.folder.name, listed.problem) == ("stopped", "never finished")


def test_run_that_wrote_nothing_leaves_no_folder(here: Path, run_egvs: Any) -> None:
    assert run_egvs("run", "mini", "--set", "sites.replace_sensor=VLP32")[0] == 2
    assert not Path("runs").exists()
    Path("chosen").mkdir()
    assert run_egvs("run", "mini", "--set", "sites.replace_sensor=VLP32", "--out", "chosen")[0] == 2
    assert Path("chosen").is_dir()


def test_run_that_waited_for_one_that_failed_has_its_folder(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, path = Path("runs/mini"), Path("runs/mini/.lock")
    try_lock = locks.wait_for_lock

    def other_run_fails_first(descriptor: int, timeout_s: float, *, shared: bool = False) -> bool:
        monkeypatch.setattr(locks, "wait_for_lock", try_lock)
        path.unlink()
        out.rmdir()
        return try_lock(descriptor, timeout_s, shared=shared)

    monkeypatch.setattr(locks, "wait_for_lock", other_run_fails_first)
    with lock_run_folder(out), pytest.raises(RunError, match="another run is using this folder"), lock_run_folder(out):
        pass


@pytest.mark.slow
def test_report_of_a_run_folder(here: Path, run_egvs: Any) -> None:
    egvs.run(egvs.load(here, ["score.gamma=5"]))
    before, record = (OTHER / "report.html").read_bytes(), RunRecord.read(OTHER)
    (OTHER / "report.html").unlink()
    code, printed, _ = run_egvs("report", OTHER)
    assert (code, str(OTHER / "report.html") in printed) == (0, True)
    assert (OTHER / "report.html").read_bytes() == before
    assert RunRecord.read(OTHER).overrides == record.overrides
    message = (
        f"egvs: {OTHER}: expected a scenario.toml, got none. This is a run folder. Give the scenario's folder, mini.\n"
    )
    assert run_egvs("run", OTHER)[::2] == (2, message)


@pytest.mark.slow
def test_folders_without_a_run_are_explained(here: Path, run_egvs: Any) -> None:
    Path("runs/stopped").mkdir(parents=True)
    Path("runs/stopped/.lock").touch()
    message = "egvs: runs/stopped: the run in this folder never finished. Leave it out, or repeat its egvs run.\n"
    assert run_egvs("compare", "runs/stopped")[::2] == (2, message)
    message = (
        "egvs: mini: this is a scenario; expected a run folder. First run egvs run mini, then give its run folder.\n"
    )
    assert run_egvs("verify", "mini")[::2] == (2, message)
    egvs.run(egvs.load(here))
    message = "egvs: mini: this is a scenario; expected a run folder. Did you mean runs/mini?\n"
    assert run_egvs("compare", "mini")[::2] == (2, message)


@pytest.mark.parametrize("words", [("export", "runs/mini", "--to", "csv"), ("place", "runs/mini"),
                                   ("verify", "runs/mini"), ("report", "runs/mini")])  # fmt: skip
def test_missing_run_folder_suggests_runs_with_other_settings(
    here: Path, run_egvs: Any, words: tuple[str, ...]
) -> None:
    for number, label in enumerate(("gamma=5", "frames=9", "gamma=6", "gamma=7")):
        message = {
            0: "egvs: runs/mini: no such folder. Give a folder",
            1: "egvs: runs/mini: no such folder. Did you mean runs/mini@gamma=5?\n",
            3: "egvs: runs/mini: no such folder. Runs with other settings are runs/mini@gamma=6, runs/mini@frames=9, "
            "runs/mini@gamma=5; egvs runs lists them.\n",
        }.get(number, "egvs: runs/mini: no such folder. ")
        code, _, printed = run_egvs(*words)
        assert code == 2 and printed.startswith(message)
        run = Path(f"runs/mini@{label}")
        run.mkdir(parents=True)
        (run / "run.json").touch()
        os.utime(run / "run.json", (100 + number, 100 + number))
    (Path("runs") / "mini2@gamma=5").mkdir()
    assert "runs/mini@frames=9 and 1 more; egvs runs lists them" in run_egvs(*words)[2]
    assert run_egvs("verify", "mini")[2].startswith(
        "egvs: mini: this is a scenario; expected a run folder. Runs with other settings are runs/mini@gamma=7, "
    )


@pytest.mark.slow
def test_list_of_another_folder(here: Path, run_egvs: Any) -> None:
    assert run_egvs("runs", "elsewhere")[::2] == (
        2, "egvs: elsewhere: no such folder. Give a folder that contains run folders.\n"
    )  # fmt: skip
    Path("elsewhere").mkdir()
    assert run_egvs("runs", "elsewhere") == (0, "no runs\n", "")
    egvs.run(egvs.load(here), "elsewhere/one")
    assert run_egvs("runs", "elsewhere")[1].splitlines()[1].startswith("one ")


# ---- commands on a run folder


def test_settings_of_a_run_are_used(here: Path) -> None:
    egvs.run(egvs.load(here, ["score.gamma=5", "sites.yaw_deg=3"]))
    (folder,) = Path("runs").glob("mini@*")
    source = SettingsSource.of(folder)
    scenario = source.load()
    assert source.is_run
    assert (scenario.score.gamma, scenario.sites.yaw_deg) == (5.0, 3.0)
    assert scenario.overrides == {"score.gamma": 5.0, "sites.yaw_deg": 3.0}
    assert source.folder(scenario) == folder
    assert run_sources.changed_files(folder, scenario) == run_sources.edited_settings(scenario) == []


@pytest.mark.slow
def test_plan_of_a_run_is_written_into_it(here: Path, run_egvs: Any) -> None:
    assert run_egvs("run", here, "--set", "score.gamma=5")[0] == 0
    scores = digests(OTHER)["scores.parquet"]
    code, printed, messages = run_egvs("place", OTHER, "--count", 1)
    assert (code, str(OTHER / "placement.parquet") in printed) == (0, True)
    assert "warning" not in messages and "differ" not in messages
    assert digests(OTHER)["scores.parquet"] == scores
    assert not Path("runs/mini").exists()
    assert RunRecord.read(OTHER).overrides == {"score.gamma": 5.0}


@pytest.mark.slow
def test_options_of_place_replace_the_request_that_a_run_recorded(here: Path, run_egvs: Any) -> None:
    (here / "scenario.toml").write_text((here / "scenario.toml").read_text() + "\n[costs]\npole = 10\n")
    assert run_egvs("place", here, "--count", 1)[0] == 0
    assert [path.name for path in Path("runs").iterdir()] == ["mini"]
    assert RunRecord.read(Path("runs/mini")).scenario["placement"]["count"] == 1
    code, printed, messages = run_egvs("place", "runs/mini", "--budget", 20)
    assert (code, "differ" in messages) == (0, False)
    assert "pole_a" in printed and "pole_b" in printed
    placement = RunRecord.read(Path("runs/mini")).scenario["placement"]
    assert (placement["count"], placement["budget"]) == (None, 20)
    assert run_egvs("place", "runs/mini")[0] == 0  # the recorded request


@pytest.mark.slow
def test_check_accepts_a_run(here: Path, run_egvs: Any) -> None:
    egvs.run(egvs.load(here, ["score.gamma=5"]))
    code, printed, _ = run_egvs("check", OTHER)
    assert (code, "checked 2 sites" in printed) == (0, True)


@pytest.mark.slow
def test_effects_of_a_run_name_its_scenario_and_overrides(here: Path, run_egvs: Any) -> None:
    egvs.run(egvs.load(here, ["score.gamma=5"]))
    code, printed, _ = run_egvs("effects", OTHER)
    assert code == 0
    assert "egvs run mini --set score.gamma=5.0 --set 'effects." in printed
    assert f"egvs accuracy {OTHER}" in printed.replace("'", "")


@needs("validation")
@pytest.mark.slow
def test_accuracy_and_validation_of_a_run_are_written_into_it(here: Path, run_egvs: Any) -> None:
    egvs.run(egvs.load(here, ["score.gamma=5"]))
    code, printed, messages = run_egvs("accuracy", OTHER, "--budget", "1s")
    assert code == 0, messages
    assert RunFolder(OTHER).accuracy.is_file()
    assert "egvs run mini --set score.gamma=5.0" in printed
    code, _, messages = run_egvs("validate", OTHER, "--frames", 10, "--detector", "points")
    assert code == 0, messages
    assert (OTHER / "detection.parquet").is_file()
    assert [path.name for path in Path("runs").iterdir()] == [OTHER.name]


@pytest.mark.parametrize(
    "verb", ["place", pytest.param("validate", marks=needs("validation")), "accuracy", "effects", "check"]
)
def test_rejects_overrides_of_a_run(here: Path, run_egvs: Any, verb: str) -> None:
    egvs.run(egvs.load(here))
    code, _, message = run_egvs(verb, "runs/mini", "--set", "score.gamma=5")
    assert code == 2
    assert message == "egvs: --set: cannot be used with a run folder (runs/mini). Give the scenario instead.\n"
    assert [path.name for path in Path("runs").iterdir()] == ["mini"]


def test_folder_with_scenario_and_run_is_a_scenario(here: Path) -> None:
    egvs.run(egvs.load(here, ["score.gamma=5"]), here)
    assert SettingsSource.of(here).load().score.gamma == 4.0


# ---- what has changed


@pytest.mark.slow
def test_says_in_which_settings_a_scenario_differs_from_its_latest_run(here: Path, run_egvs: Any) -> None:
    def note(*words: object) -> str:
        lines = run_egvs("place", here, "--count", 1, *words)[2].splitlines()
        return "\n".join(line for line in lines if "differ" in line)

    assert note() == ""  # no run
    egvs.run(egvs.load(here, ["score.gamma=5", "traffic.frames=20"]))
    latest = Path("runs/mini@frames=20,gamma=5")
    make_later(latest, 60)
    there = f"settings differ from the latest run, {latest}: "
    assert note() == f"{there}score.gamma (5 there, 4 here), traffic.frames (20 there, 40 here)"
    assert note("--set", "score.gamma=5") == f"{there}traffic.frames (20 there, 40 here)"
    assert note("--set", "score.gamma=5", "--set", "traffic.frames=20") == ""
    egvs.run(egvs.load(here))
    make_later(latest, 120)
    assert note() == ""  # an earlier run has these settings


@pytest.mark.slow
def test_effect_with_default_parameters_is_on(here: Path, run_egvs: Any) -> None:
    egvs.run(egvs.load(here, ["effects.moving_occlusion={}"]))
    assert [path.name for path in Path("runs").iterdir()] == ["mini@moving_occlusion=on"]
    assert "  differs in  effects.moving_occlusion=on\n" in run_egvs("runs", "--verbose")[1]
    messages = run_egvs("place", here, "--count", 1)[2]
    assert "mini@moving_occlusion=on: effects.moving_occlusion (on there, off here)\n" in messages


@pytest.mark.slow
def test_latest_run_is_one_of_the_same_scenario(here: Path, tmp_path: Path) -> None:
    from tests.conftest import write_mini

    other = write_mini(tmp_path / "other")
    egvs.run(egvs.load(here))
    egvs.run(egvs.load(other, ["score.gamma=5"]))
    make_later(Path("runs/other@gamma=5"), 60)
    latest = run_list.latest_difference(egvs.load(here), Path("runs/mini"))
    assert latest == (Path("runs/mini"), {})


def test_run_given_by_out_is_compared_as_well(here: Path) -> None:
    egvs.run(egvs.load(here, ["score.gamma=5"]), "kept")
    latest = run_list.latest_difference(egvs.load(here), Path("kept"))
    assert latest == (Path("kept"), {"score.gamma": (5.0, 4.0)})
    assert run_list.latest_difference(egvs.load(here), Path("runs/mini")) is None


@pytest.mark.slow
def test_warns_of_files_that_have_changed_since_the_run(here: Path, run_egvs: Any) -> None:
    egvs.run(egvs.load(here, ["score.gamma=5"]))
    (here / "sites.csv").write_text((here / "sites.csv").read_text() + "pole_c,15,-8,3\n")
    code, printed, messages = run_egvs("place", OTHER, "--count", 1)
    assert code == 0
    assert f"warning: sites.csv has changed since the run in {OTHER}: its stages run again as needed" in messages
    assert "The plan pole_c " in printed


@pytest.mark.slow
def test_says_which_settings_the_scenario_file_has_changed_since_the_run(here: Path, run_egvs: Any) -> None:
    egvs.run(egvs.load(here, ["score.gamma=5"]))
    file = here / "scenario.toml"
    file.write_text(file.read_text().replace("frames = 40", "frames = 20").replace("gamma = 4", "gamma = 3"))
    messages = run_egvs("place", OTHER, "--count", 1)[2]
    assert f"the settings of {OTHER} are used; mini/scenario.toml now differs in traffic.frames\n" in messages
    assert RunRecord.read(OTHER).scenario["traffic"]["frames"] == 40


def test_run_whose_scenario_is_gone_is_rejected(here: Path, run_egvs: Any) -> None:
    egvs.run(egvs.load(here))
    here.rename("moved")
    code, _, message = run_egvs("place", "runs/mini", "--count", 1)
    assert (code, message) == (
        2,
        "egvs: runs/mini/run.json: the scenario's folder mini does not exist. Give the scenario instead of the run.\n",
    )


# ---- the record


def test_record_with_overrides_of_another_type_is_rejected(here: Path) -> None:
    egvs.run(egvs.load(here))
    path = RunFolder(Path("runs/mini")).run_record
    values = json.loads(path.read_text()) | {"overrides": ["score.gamma"]}
    del values[checksums.CHECKSUM_KEY]
    path.write_text(json.dumps(add_checksum(values)))
    with pytest.raises(InputError, match="'overrides' is"):
        RunRecord.read(Path("runs/mini"))


WRITTEN = (
    ["score.gamma=5.0"],
    ["score.gamma=inf"],
    ["effects.rain={rate_mm_h=20}", "effects.divergence={}"],
    ["traffic.kinds.car.length_m=5"],
    ['sites.sensor="VLP-16"', 'description="a \\"b\\"\\n"'],
    ["sites.pitch_deg=[0, 10]", 'statics.polygons=["a.poly.xml"]', "statics.polygon_types={building.shed=2.5}"],
)


@pytest.mark.parametrize("overrides", WRITTEN, ids=lambda overrides: overrides[0])
def test_recorded_overrides_can_be_given_again(mini: Path, overrides: list[str]) -> None:
    scenario = egvs.load(mini, overrides)
    assert scenario.overrides
    again = egvs.load(mini, format_overrides(scenario.overrides))
    assert again == scenario
    assert again.overrides == scenario.overrides
