"""All scores of all sites of a scenario: from stages and store, the same at any number of threads."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.core.errors import InputError, MissingBackendError, RunError
from egvs.extensions.validation import surrogates
from egvs.extensions.validation.surrogates import compute_surrogates
from egvs.scoring.target_scores import points_on_target
from egvs.scoring.targets import TargetRecord, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from tests.conftest import write_mini
from tests.core.test_plugins import install, site  # noqa: F401  the fixture
from tests.docs.test_extending import package

GAMMAS = (1, 2, 4, 5, 10, 20, math.inf)  # 4 is the scenario's own


@pytest.fixture(scope="module")
def computed(tmp_path_factory):
    """A scenario, its work folder, and its scores."""
    folder = tmp_path_factory.mktemp("scores")
    scenario = egvs.load(write_mini(folder / "mini"))
    return scenario, folder / "work", compute_surrogates(scenario, folder / "work", jobs=1)


def values(scores, score, **parameters):
    """Of each site, of the rows with these parameters."""
    rows = [row for row in scores.rows if row.score == score and dict(row.parameters) == parameters]
    return {row.site: row.value for row in rows}


def test_one_row_per_site_score_and_parameters(computed):
    scenario, _, scores = computed
    tried = [(row.site, row.score, row.parameters_json) for row in scores.rows]
    assert len(set(tried)) == len(tried) == 2 * (len(GAMMAS) * 3 * 2 + 16 + 2 + 18)
    assert list(dict.fromkeys(row.site for row in scores.rows)) == ["pole_a", "pole_b"]
    assert list(dict.fromkeys(row.score for row in scores.rows)) == surrogates.score_names()
    gammas = {row.parameters["gamma"] for row in scores.rows if row.score == "egvs"}
    assert gammas == set(GAMMAS) and scores.skipped == () and scenario.score.gamma == 4
    assert all(row.seconds >= 0 and math.isfinite(row.value) for row in scores.rows)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "parameters"),
    [
        ([], {"gamma": 4.0, "voxel_m": 0.5, "moving_occlusion": False}),
        (["roi.voxel_m=0.25", "score.gamma=inf"], {"gamma": math.inf, "voxel_m": 0.25, "moving_occlusion": False}),
        (["effects.moving_occlusion={}"], {"gamma": 4.0, "voxel_m": 0.5, "moving_occlusion": True}),
    ],
)
def test_egvs_equals_score_of_run_exactly(computed, tmp_path, settings, parameters):
    scenario, _, scores = computed
    egvs.run(egvs.load(scenario.folder, settings), tmp_path / "run")
    table = egvs.read_scores(tmp_path / "run" / "scores.parquet").to_pydict()
    assert values(scores, "egvs", **parameters) == dict(zip(table["site"], table["egvs"], strict=True))
    if not settings:
        assert values(scores, "entropy_seen") == dict(zip(table["site"], table["entropy_seen"], strict=True))


def test_points_come_from_traffic_of_tpog(computed):
    scenario, work, scores = computed
    record = TargetRecord.read(work / "trajectories.parquet", scenario.roi.grid)
    assert len(record.numbers) == 40  # all of them: fewer than 250
    scene = egvs.build_scene(scenario)
    for one in scene.sites:
        beams = Beams.of(Scanner(scene).scan_site(one))
        visible = visible_targets(record, beams)
        mean = float(np.log1p(visible.points).mean())
        assert visible.points.sum() > 0 and values(scores, "points_on_target")[one.name] == pytest.approx(mean)
        assert values(scores, "points_on_target")[one.name] == points_on_target(visible)


@pytest.mark.slow
def test_bytes_do_not_depend_on_threads(computed, tmp_path):
    scenario, _, scores = computed
    again = compute_surrogates(scenario, tmp_path / "work", jobs=3)
    for number, one in enumerate((scores, again)):
        one.write(tmp_path / f"{number}.parquet", scenario)
    assert (tmp_path / "0.parquet").read_bytes() == (tmp_path / "1.parquet").read_bytes()
    table, metadata = parquet.read_artefact(tmp_path / "0.parquet", "surrogates")
    assert metadata["inputs"] == scores.inputs and len(table) == len(scores.rows)
    row = json.loads(table.column("parameters")[0].as_py())
    assert row == {"gamma": 1.0, "moving_occlusion": False, "voxel_m": 0.25}
    assert '"gamma":"inf"' in "".join(table.column("parameters").to_pylist())
    assert set(scores.costs_ms()) == set(surrogates.score_names())


def test_skips_voxel_sizes_that_do_not_fit(computed, tmp_path):
    scenario, _, _ = computed
    narrow = egvs.load(scenario.folder, ["roi.size_m=[40, 20, 4.5]"])
    scores = compute_surrogates(narrow, tmp_path / "work", ["egvs", "coverage"], jobs=1)
    assert {row.parameters.get("voxel_m", 0.5) for row in scores.rows} == {0.25, 0.5}
    (skipped,) = scores.skipped
    assert "scores with voxels of 1 m are skipped" in skipped.where and "4.5 m along z" in skipped.problem


def test_rejects_unknown_score(computed, tmp_path):
    with pytest.raises(InputError, match=r"unknown score 'egsv'. Choose one of egvs, "):
        compute_surrogates(computed[0], tmp_path, ["egsv"])


def test_computes_score_of_another_package(computed, tmp_path, site: Path) -> None:  # noqa: F811
    (source,) = (text for name, text in package("A score").items() if name.endswith(".py"))
    install(site, "near-points", "near_points = plug_near:NEAR_POINTS", {"plug_near": source}, surrogates.SCORES_GROUP)
    scenario, _, _ = computed
    scores = compute_surrogates(scenario, tmp_path / "work", ["near_points"], jobs=1)
    tried = {(row.site, row.parameters["within_m"]): row.value for row in scores.rows}
    assert len(tried) == 4 and all(0 < tried[s, 20.0] < tried[s, 50.0] for s in ("pole_a", "pole_b"))
    assert "near_points" in surrogates.score_names()


WRONG = """\
from egvs.extensions.validation.surrogates import SurrogateScore
S = SurrogateScore('wrong', 'f', 's', 1, lambda e: {})
"""


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        ("S = dict", "expected a egvs.extensions.validation.surrogates.SurrogateScore, got a type"),
        (
            WRONG + "from types import SimpleNamespace\nS = SimpleNamespace(**vars(S))",
            "expected a egvs.extensions.validation.surrogates.SurrogateScore, got a",
        ),
        (WRONG.replace("'wrong'", "'good'"), "expected the name 'wrong' of its entry point, got 'good'"),
        (WRONG.replace("1,", "2,"), "or -1, got 2"),
        (
            WRONG.replace("{})", "0.0, ('hits',))"),
            "expected needs of hit_counts, log_reach, returns, vehicles, vehicle_points, got 'hits'",
        ),
        (WRONG.replace("{})", "0.0, (), {'a': ()})"), "expected at least one value of a in its sweep, got none"),
        ("import no_such_library", "No module named 'no_such_library'"),
    ],
)
def test_rejects_invalid_plugin_and_lists_its_problem(site: Path, source, problem):  # noqa: F811
    install(site, "somebody-elses", "wrong = plug_wrong:S", {"plug_wrong": source}, surrogates.SCORES_GROUP)
    with pytest.raises(MissingBackendError, match=rf"^'wrong' of egvs\.scores cannot be loaded: .*{problem}"):
        surrogates.load_score("wrong")
    (entry,) = (entry for entry in surrogates.score_catalogue() if entry.name == "wrong")
    assert entry.score is None and entry.package == "somebody-elses" and problem in entry.problem


@pytest.mark.slow
def test_skips_unloadable_score_with_warning(computed, tmp_path, site: Path):  # noqa: F811
    install(
        site, "somebody-elses", "wrong = plug_wrong:S", {"plug_wrong": "raise RuntimeError"}, surrogates.SCORES_GROUP
    )
    scenario, work, scores = computed
    again = compute_surrogates(scenario, work, jobs=1)
    assert [str(skipped).split(":")[0] for skipped in again.skipped] == ["score wrong is skipped"]
    assert [(row.site, row.score, row.value) for row in again.rows] == [(r.site, r.score, r.value) for r in scores.rows]


@pytest.mark.parametrize("given", ["'much'", "None", "[1.0]"])
def test_names_score_that_returns_no_number(computed, tmp_path, site: Path, given):  # noqa: F811
    install(
        site,
        "somebody-elses",
        "wrong = plug_wrong:S",
        {"plug_wrong": WRONG.replace("{}", given)},
        surrogates.SCORES_GROUP,
    )
    with pytest.raises(RunError, match=r"score wrong: site pole_a: expected a number, or NaN"):
        compute_surrogates(computed[0], tmp_path / "work", ["wrong"], jobs=1)
