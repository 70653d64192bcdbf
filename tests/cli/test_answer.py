"""The answer at the end of ``egvs run``."""

import re
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest

import egvs
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.cli import answer
from egvs.core.errors import WARNINGS_KEY, Diagnostic, collect_warnings
from egvs.report import ranking_text, sections
from egvs.report.reliability import by_severity, describe_reliability
from egvs.results.plans import SensorPlan
from egvs.results.ranking import Ranking
from egvs.traffic import trajectories
from tests.report.small_runs import PageReader
from tests.results.test_ranking import by_vehicles

MOUNTS = "site,x_m,y_m,z_m,pitch_deg\n" + "".join(
    f"{pole}_{z_m},{x_m},{y_m},{z_m},-10\n"
    for pole, x_m, y_m in (("a", 10, 12), ("b", 30.5, -12), ("c", 2, -12), ("d", 38, 12), ("e", 20, 12), ("f", 25, -12))
    for z_m in (5, 3)
)


@pytest.fixture
def six_poles(mini: Path) -> Path:
    (mini / "sites.csv").write_text(MOUNTS)
    return mini


STAGE_LINE = re.compile(r"\w+ +(\d+\.\d s|unchanged|from store) ")
ASSUMED = ("traffic (guessed)", "signal plans", "heights of 3 trees", "positions of the poles")


def answer_lines(printed: str, error: str) -> list[str]:
    """Return what follows the stages: warnings, and the answer."""
    return [line for line in error.splitlines() if line and not STAGE_LINE.match(line)] + printed.splitlines()


@pytest.mark.slow
def test_the_answer_has_twelve_lines(six_poles: Path, tmp_path: Path, run_egvs) -> None:
    """With warnings, assumptions and six poles; the table has as many of them as there is room for."""
    with (six_poles / "sites.csv").open("a") as file:
        file.write("a_5_again,10,12,5,-10\nskywards,10,12,5,60\n")
    out = tmp_path / "out"
    settings = ("--out", out, "--set", f"assumed={list(ASSUMED)}", "--set", "score.rank_by='expected_detections'")
    code, printed, error = run_egvs("run", six_poles, *settings)
    assert code == 0, error
    lines = answer_lines(printed, error)
    assert len(lines) <= answer.MAX_LINES
    assert max(map(len, lines[:-1])) <= 100  # the last one has a path
    assert len(" ".join(lines).split()) <= 200
    rows = [line for line in lines if re.match(r"\d  ", line)]
    assert answer.MIN_POLES <= len(rows) <= answer.DEFAULT_POLES
    warnings = collect_warnings(stage.summary for stage in RunRecord.read(out).stages.values())
    assert len(warnings) > 1
    assert lines[0].startswith(f"{len(warnings)} warnings; the most serious: {by_severity(warnings)[0].where}")
    assert "Assumed, not measured: traffic (guessed); positions of the poles; 2 more." in lines
    assert lines[-1].startswith(f"report: {out / 'report.html'} ")
    assert len(answer_lines(*run_egvs("run", six_poles, *settings, "--top", "6")[1:])) > len(lines)


def finer_tilts(best_deg: float, tried_deg: tuple[float, ...]) -> str:
    """The hint for a pole "Ampel Nord" with these tilts; at each, with another sensor too."""
    mounts = [SimpleNamespace(pole="Ampel Nord", sensor="VLP-32C", pitch_deg=pitch_deg) for pitch_deg in tried_deg]
    best = next(mount for mount in mounts if mount.pitch_deg == best_deg)
    others = [SimpleNamespace(pole="Ampel Nord", sensor="other", pitch_deg=-90.0 + 1.0 * i) for i in range(180)]
    ranked = SimpleNamespace(best=(best,), poles=(SimpleNamespace(name="Ampel Nord", sites=(*mounts, *others)),))
    return answer._finer_tilts(RunFolder(Path("my run")), ranked)  # type: ignore[arg-type]


def test_hints_at_finer_tilts_where_the_best_one_is_at_the_edge_or_between_coarse_ones() -> None:
    command = ["Finer", "tilts:", "egvs", "place", "my run", "--count", "1", "--refine"]
    for best_deg, tried_deg in ((0.0, (0.0, -5.0, -10.0)), (-10.0, (0.0, -5.0, -10.0)), (-10.0, (0.0, -10.0, -20.0))):
        assert shlex.split(finer_tilts(best_deg, tried_deg)) == command
    assert finer_tilts(-5.0, (0.0, -5.0, -10.0)) == ""
    assert finer_tilts(0.0, (0.0,)) == ""


@pytest.mark.slow
def test_no_fact_is_lost_in_the_report_and_with_verbose(six_poles: Path, tmp_path: Path, run_egvs) -> None:
    """Each warning, assumption and caveat, the lead, poles and scores."""
    with (six_poles / "sites.csv").open("a") as file:
        file.write("a_5_again,10,12,5,-10\nskywards,10,12,5,60\n")
    out = tmp_path / "out"
    settings = ("--out", out, "--set", f"assumed={list(ASSUMED)}", "--set", "score.rank_by='expected_detections'")
    code, printed, error = run_egvs("run", six_poles, *settings, "--verbose")
    assert code == 0, error
    record, ranked = RunRecord.read(out), Ranking.read(out / "scores.parquet")
    scenario = egvs.load(six_poles, ["score.rank_by='expected_detections'"])
    facts = [warning.problem for stage in record.stages.values() for warning in collect_warnings([stage.summary])]
    facts += describe_reliability(ranked, record.traffic_summary, scenario.score.ranking_detectors)
    facts += [*ASSUMED, ranking_text.lead(ranked), *(pole.name for pole in ranked.poles)]
    facts += [ranked.best[0].noticed_cell, ranked.by.value(ranked.best[0].score), f"{ranked.best[0].egvs:,.0f}"]
    assert len(facts) > 12
    page = PageReader((out / "report.html").read_text(encoding="utf-8")).text
    for text in (printed + error, page):
        plain = " ".join(text.replace("\u2019", "'").replace("\u00a0", " ").split())
        assert [fact for fact in facts if " ".join(fact.replace("\u2019", "'").split()) not in plain] == []


@pytest.mark.slow
def test_a_pole_in_a_lane_is_named_whatever_else_is_warned_of(
    mini: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario, out = egvs.load(mini), tmp_path / "out"
    record = egvs.run(scenario, out)
    answer.print_answer(out, scenario, record)
    assert "Careful" not in capsys.readouterr().out
    best = Ranking.read(out / "scores.parquet").best[0].site
    in_lane = Diagnostic("sites on lanes", f"sites.csv: site {best}", "(1, 2, 3) is in a lane of Mill Lane", "")
    record.stages["check"].summary[WARNINGS_KEY] = [in_lane.to_json()]
    answer.print_answer(out, scenario, record)
    assert f"\nCareful: {best} stands in a lane of Mill Lane.\n" in capsys.readouterr().out


@pytest.mark.slow
def test_vehicles_that_could_not_start_are_a_caveat_of_answer_report_and_plan(
    mini: Path, tmp_path: Path, run_egvs, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = "1,542 of 2,887 vehicles could not start, because the streets where they start are full"
    warnings = [
        Diagnostic("overlaps", "traffic", "vehicles overlap", ""),
        Diagnostic("waiting", "traffic", problem, ""),
    ]
    monkeypatch.setattr(trajectories, "traffic_warnings", lambda *_: warnings)
    careful = "Careful: 1,542 of 2,887 vehicles could not start, so the traffic is less than the demand."
    for options in ((), ("--verbose",)):
        code, printed, error = run_egvs("run", mini, "--out", tmp_path / "out", *options)
        assert code == 0, error
        assert careful in printed
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert careful in page[: page.index("<main>")]
    assert careful in " ".join(run_egvs("place", mini, "--out", tmp_path / "out", "--count", "1")[1].split())


@pytest.mark.slow
def test_plans_in_one_go(six_poles: Path, tmp_path: Path, run_egvs) -> None:
    out = tmp_path / "out"
    code, printed, error = run_egvs("run", six_poles, "--out", out, "--count", "2")
    assert code == 0, error
    assert printed.startswith("Site f_3, ")
    assert "\nThe plan " in printed
    plan = SensorPlan.read(RunFolder(out))
    assert plan is not None
    assert len(plan.sensors) == 2


@pytest.mark.slow
def test_says_what_was_assumed(mini: Path, tmp_path: Path, run_egvs) -> None:
    settings = ("--set", "assumed=['traffic (guessed)', 'positions of the poles']")
    code, printed, error = run_egvs("run", mini, "--out", tmp_path / "out", *settings)
    assert code == 0, error
    assert "Assumed, not measured: traffic (guessed); positions of the poles." in printed
    assert "traffic (guessed); positions of the poles" in (tmp_path / "out" / "report.html").read_text()
    assert "not measured" not in run_egvs("run", mini, "--out", tmp_path / "two")[1]


def test_poles_in_a_lane_and_assumptions_are_one_sentence(mini: Path) -> None:
    guessed = egvs.load(mini, ["assumed=['traffic (guessed)']"])
    sentence = "Before you trust this ranking: k02 stands in a lane; assumed, not measured: traffic (guessed)."
    assert sections.describe_caveats(guessed, "ranking", ["k02 stands in a lane"]) == sentence
    assert sections.describe_caveats(egvs.load(mini), "plan", ["a", "b"]) == "Before you trust this plan: a and b."
    assert sections.describe_caveats(egvs.load(mini), "plan") == ""


def test_signal_plans_are_no_assumption_once_they_are_given(mini: Path) -> None:
    """The entry goes when every signal of the region has a plan; otherwise it names those without."""
    keys = ["assumed=['traffic (guessed)', 'signal plans']"]
    given = {"signal": "a", "streets": ["Mill Lane", "High Street"], "source": "from the scenario"}
    guessed = {"signal": "b", "streets": ["Oak Street"], "source": "assumed"}
    none = egvs.load(mini, keys)
    assert sections.assumptions(none, [guessed]) == ("traffic (guessed)", "signal plans")
    plan = {"phases": [{"green": {"north": ["all"]}, "green_s": 30}]}
    some = none.model_copy(update={"traffic": none.traffic.model_copy(update={"signals": {"a": plan}})})
    assert sections.assumptions(some, [given]) == ("traffic (guessed)",)
    assert sections.assumptions(some, [given, guessed]) == ("traffic (guessed)", "signal plans of Oak Street")
    sentence = "Before you trust this ranking: assumed, not measured: traffic (guessed)."
    assert sections.describe_caveats(some, "ranking", plans=[given]) == sentence


def test_existing_poles_are_no_assumption_and_missing_surroundings_are(mini: Path) -> None:
    keys = ["assumed=['traffic (guessed)', 'positions of the poles']"]
    for existing, poles in (("'all'", ()), ("['pole_a']", ("positions of the poles other than pole_a",))):
        scenario = egvs.load(mini, [*keys, f"sites.existing_poles={existing}"])
        assert sections.assumptions(scenario, ()) == ("traffic (guessed)", *poles)
    bare = egvs.load(mini, [*keys, "statics.footprints=[]"])
    assert sections.assumptions(bare, ())[2:] == ("surroundings (no building or tree is known)",)


@pytest.mark.slow
def test_says_that_losses_of_several_sensors_are_off_where_they_are(mini: Path, tmp_path: Path, run_egvs) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,sensor\na,10,12,5,VLP-16\nb,30.5,-12,5,VLP-32C\n")
    scenario = mini / "scenario.toml"
    scenario.write_text(scenario.read_text().replace('sensor = "small"\n', "", 1))
    folders = [str(tmp_path / name) for name in ("plain", "limited")]
    texts = []
    for folder, settings in zip(folders, (("--set", "effects.range_limit=false"), ()), strict=True):
        code, printed, error = run_egvs("run", mini, "--out", folder, *settings, "--verbose")
        assert code == 0, error
        page = Path(folder, "report.html").read_text(encoding="utf-8")
        texts += [printed, page, run_egvs("compare", folder)[1]]
    note = "a sensor without them looks better than it is"
    assert [text.count(note) for text in texts] == [1, 2, 1, 0, 0, 0]
    assert note in run_egvs("compare", *folders)[1]


def test_names_the_best_sites_by_egvs_where_another_score_prefers_others() -> None:
    ranked = by_vehicles(("a", 50.0, 0.9), ("b", 90.0, 0.8), ("c", 20.0, 0.7), ("d", 80.0, 0.6))
    assert answer.order_by_egvs(ranked, {"gamma": 10.0}) == (
        "The EGVS (gamma 10) measures the traffic's uncertainty that beams cross, not the share of vehicles found, and "
        "prefers b, d and a."
    )
    agreed = by_vehicles(("b", 90.0, 0.9), ("d", 80.0, 0.8))
    assert answer.order_by_egvs(agreed, {"gamma": 10.0}) == ""


@pytest.mark.slow
def test_details_only_on_request(mini: Path, tmp_path: Path, run_egvs) -> None:
    brief, error = run_egvs("run", mini, "--out", tmp_path / "out")[1:]
    verbose, verbose_error = run_egvs("run", mini, "--out", tmp_path / "out", "--verbose")[1:]
    assert "voxels occupied at least once" not in error and "voxels occupied at least once" in verbose_error
    assert "peak MB" not in brief and "peak MB" in verbose
