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
from egvs.scoring.target_scores import points_on_target
from egvs.scoring.targets import TargetRecord, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.validation import surrogates
from egvs.validation.surrogates import compute_surrogates
from tests.conftest import write_mini
from tests.core.test_plugins import install, site  # noqa: F401  the fixture
from tests.docs.test_extending import package

GAMMAS = (1, 2, 4, 5, 10, 20, math.inf)  # 4 is the scenario's own


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A scenario, the folder where it was worked, and its scores."""
    folder = tmp_path_factory.mktemp("scores")
    scenario = egvs.load(write_mini(folder / "mini"))
    return scenario, folder / "work", compute_surrogates(scenario, folder / "work", jobs=1)


def values(found, score, **parameters):
    """Of each site, of the rows with these parameters."""
    rows = [row for row in found.rows if row.score == score and dict(row.parameters) == parameters]
    return {row.site: row.value for row in rows}


def test_there_is_a_row_for_each_site_score_and_choice_of_parameters(made):
    scenario, _, found = made
    tried = [(row.site, row.score, row.parameters_json) for row in found.rows]
    assert len(set(tried)) == len(tried) == 2 * (len(GAMMAS) * 3 * 2 + 15)
    assert list(dict.fromkeys(row.site for row in found.rows)) == ["pole_a", "pole_b"]
    assert list(dict.fromkeys(row.score for row in found.rows)) == surrogates.score_names()
    gammas = {row.parameters["gamma"] for row in found.rows if row.score == "egvs"}
    assert gammas == set(GAMMAS) and found.skipped == () and scenario.score.gamma == 4
    assert all(row.seconds >= 0 and math.isfinite(row.value) for row in found.rows)


@pytest.mark.parametrize(
    ("settings", "parameters"),
    [
        ([], {"gamma": 4.0, "voxel_m": 0.5, "moving_occlusion": False}),
        (["roi.voxel_m=0.25", "score.gamma=inf"], {"gamma": math.inf, "voxel_m": 0.25, "moving_occlusion": False}),
        (["effects.moving_occlusion={}"], {"gamma": 4.0, "voxel_m": 0.5, "moving_occlusion": True}),
    ],
)
def test_egvs_is_what_a_run_scores_to_the_last_bit(made, tmp_path, settings, parameters):
    scenario, _, found = made
    egvs.run(egvs.load(scenario.folder, settings), tmp_path / "run")
    table = egvs.read_scores(tmp_path / "run" / "scores.parquet").to_pydict()
    assert values(found, "egvs", **parameters) == dict(zip(table["site"], table["egvs"], strict=True))
    if not settings:
        assert values(found, "entropy_seen") == dict(zip(table["site"], table["entropy_seen"], strict=True))


def test_points_are_those_of_the_record_that_the_tpog_was_counted_from(made):
    scenario, work, found = made
    record = TargetRecord.read(work / "trajectories.parquet", scenario.roi.grid)
    assert len(record.numbers) == 40  # all of them: fewer than 250
    scene = egvs.build_scene(scenario)
    for one in scene.sites:
        beams = Beams.of(Scanner(scene).scan_site(one))
        seen = visible_targets(record, beams)
        mean = float(np.log1p(seen.points).mean())
        assert seen.points.sum() > 0 and values(found, "points_on_target")[one.name] == pytest.approx(mean)
        assert values(found, "points_on_target")[one.name] == points_on_target(seen)


def test_the_file_has_the_same_bytes_at_any_number_of_threads(made, tmp_path):
    scenario, _, found = made
    again = compute_surrogates(scenario, tmp_path / "work", jobs=3)
    for number, one in enumerate((found, again)):
        one.write(tmp_path / f"{number}.parquet", scenario)
    assert (tmp_path / "0.parquet").read_bytes() == (tmp_path / "1.parquet").read_bytes()
    table, about = parquet.read_artefact(tmp_path / "0.parquet", "surrogates")
    assert about["inputs"] == found.inputs and len(table) == len(found.rows)
    row = json.loads(table.column("parameters")[0].as_py())
    assert row == {"gamma": 1.0, "moving_occlusion": False, "voxel_m": 0.25}
    assert '"gamma":"inf"' in "".join(table.column("parameters").to_pylist())
    assert set(found.costs_ms()) == set(surrogates.score_names())


def test_voxels_that_do_not_fit_are_left_out_and_told(made, tmp_path):
    scenario, _, _ = made
    narrow = egvs.load(scenario.folder, ["roi.size_m=[40, 20, 4.5]"])
    found = compute_surrogates(narrow, tmp_path / "work", ["egvs", "coverage"], jobs=1)
    assert {row.parameters.get("voxel_m", 0.5) for row in found.rows} == {0.25, 0.5}
    (told,) = found.skipped
    assert "scores with voxels of 1 m are skipped" in told.where and "4.5 m along z" in told.problem


def test_an_unknown_score_is_named(made, tmp_path):
    with pytest.raises(InputError, match=r"unknown score 'egsv'. Use one of egvs, entropy_seen"):
        compute_surrogates(made[0], tmp_path, ["egsv"])


def test_a_score_of_another_package_is_computed_beside_the_others(made, tmp_path, site: Path) -> None:  # noqa: F811
    (source,) = (text for name, text in package("A score").items() if name.endswith(".py"))
    install(site, "near-points", "near_points = plug_near:NEAR_POINTS", {"plug_near": source}, surrogates.SCORES_GROUP)
    scenario, _, _ = made
    found = compute_surrogates(scenario, tmp_path / "work", ["near_points"], jobs=1)
    tried = {(row.site, row.parameters["within_m"]): row.value for row in found.rows}
    assert len(tried) == 4 and all(0 < tried[s, 20.0] < tried[s, 50.0] for s in ("pole_a", "pole_b"))
    assert "near_points" in surrogates.score_names()


WRONG = (
    "from egvs.validation.surrogates import SurrogateScore\nS = SurrogateScore('wrong', 'f', 's', 1, lambda e: {})\n"
)


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        ("S = dict", "it has no name, formula, source, sign, function"),
        (
            WRONG + "from types import SimpleNamespace\nS = SimpleNamespace(**vars(S))",
            "expected a egvs.validation.surrogates.SurrogateScore, got a",
        ),
        (WRONG.replace("'wrong'", "'good'"), "expected the name 'wrong' of its entry point, got 'good'"),
        (WRONG.replace("1,", "2,"), "or -1, got 2"),
        (
            WRONG.replace("{})", "0.0, ('hits',))"),
            "expected needs of hit_counts, log_reach, returns, vehicles, got 'hits'",
        ),
        (WRONG.replace("{})", "0.0, (), {'a': ()})"), "expected at least one value of a in its sweep, got none"),
        ("import no_such_library", "No module named 'no_such_library'"),
    ],
)
def test_what_is_no_score_is_refused_by_name_and_listed_as_broken(site: Path, source, problem):  # noqa: F811
    install(site, "somebody-elses", "wrong = plug_wrong:S", {"plug_wrong": source}, surrogates.SCORES_GROUP)
    with pytest.raises(MissingBackendError, match=rf"^'wrong' of egvs\.scores cannot be loaded: .*{problem}"):
        surrogates.load_score("wrong")
    (entry,) = (entry for entry in surrogates.score_catalogue() if entry.name == "wrong")
    assert entry.score is None and entry.package == "somebody-elses" and problem in entry.problem


def test_one_that_nobody_named_and_that_cannot_be_loaded_is_left_out_and_told(made, tmp_path, site: Path):  # noqa: F811
    install(
        site, "somebody-elses", "wrong = plug_wrong:S", {"plug_wrong": "raise RuntimeError"}, surrogates.SCORES_GROUP
    )
    scenario, work, found = made
    again = compute_surrogates(scenario, work, jobs=1)
    assert [str(told).split(":")[0] for told in again.skipped] == ["score wrong is skipped"]
    assert [(row.site, row.score, row.value) for row in again.rows] == [(r.site, r.score, r.value) for r in found.rows]


@pytest.mark.parametrize("given", ["'much'", "None", "[1.0]"])
def test_a_score_that_gives_no_number_is_named(made, tmp_path, site: Path, given):  # noqa: F811
    install(
        site,
        "somebody-elses",
        "wrong = plug_wrong:S",
        {"plug_wrong": WRONG.replace("{}", given)},
        surrogates.SCORES_GROUP,
    )
    with pytest.raises(RunError, match=r"score wrong: site pole_a: expected a number, or NaN"):
        compute_surrogates(made[0], tmp_path / "work", ["wrong"], jobs=1)
