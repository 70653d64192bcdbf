"""Settings give the scores of ``egvs run --set``; the explored run does not change."""

from __future__ import annotations

from pathlib import Path

import pytest

import egvs
from egvs.core.errors import InputError
from egvs.explore.session import Session
from egvs.explore.settings import SessionFactory, Settings, offered_effects, open_session, trial_parameters
from egvs.runs import stage_registry
from tests.explore.test_session import MOVED, scored, write_site
from tests.explore.test_session import SITES as FOUR_SITES

ANOTHER = {
    "gamma": (Settings(2.5, "egvs", frozenset()), ["score.gamma=2.5"]),
    "no limit": (Settings(float("inf"), "egvs", frozenset()), ["score.gamma=inf"]),
    "points": (Settings(None, "points_on_target", frozenset()), ["score.rank_by=points_on_target"]),
    "detections": (
        Settings(1.0, "expected_detections", frozenset()),
        ["score.rank_by=expected_detections", "score.gamma=1"],
    ),
    "occlusion": (Settings(None, "egvs", frozenset({"moving_occlusion"})), ["effects.moving_occlusion={}"]),
}


@pytest.fixture
def session(mini: Path, tmp_path: Path) -> Session:
    """A session over the small scenario."""
    return open_session(mini, (), tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("name", ANOTHER)
def test_session_with_settings_has_the_scores_of_a_run(session: Session, mini: Path, tmp_path: Path, name: str) -> None:
    settings, overrides = ANOTHER[name]
    before = {path.name: path.read_bytes() for path in session.work.folder.path.iterdir()}
    tried = SessionFactory(session, tmp_path / "scratch").session(settings)
    candidates = {row: dict(tried.candidates[row].scores) for row in tried.candidates}
    moved = tried.rate("pole_a", MOVED)
    assert {path.name: path.read_bytes() for path in session.work.folder.path.iterdir()} == before
    rows = scored(mini, *overrides)
    assert candidates == {site: {key: row[key] for key in candidates[site]} for site, row in rows.items()}
    assert all(candidate.rank == rows[site]["rank"] for site, candidate in tried.candidates.items())
    write_site(mini, "pole_a", MOVED)
    row = scored(mini, *overrides)["pole_a"]
    assert dict(moved.scores) == {key: row[key] for key in moved.scores}
    assert moved.rank == row["rank"]
    assert settings.overrides(session.scenario) == tuple(sorted(overrides))


@pytest.mark.slow
def test_effect_can_be_switched_off(mini: Path, tmp_path: Path) -> None:
    rainy = open_session(mini, ["effects.rain.rate_mm_h=20"], tmp_path / "run")
    dry = Settings(None, "egvs", frozenset())
    tried = SessionFactory(rainy, tmp_path / "scratch").session(dry)
    assert dict(tried.candidates["pole_a"].scores) == {
        key: scored(mini)["pole_a"][key] for key in ("egvs", "entropy_seen", "expected_detections", "noticed")
    }
    assert rainy.candidates["pole_a"].scores["egvs"] < tried.candidates["pole_a"].scores["egvs"]
    assert dry.overrides(rainy.scenario) == ("without effects.rain",)


def test_unchanged_settings_give_the_initial_session(session: Session, tmp_path: Path) -> None:
    variants = SessionFactory(session, tmp_path / "scratch")
    assert variants.session(Settings.from_scenario(session.scenario)) is session
    assert not (tmp_path / "scratch").exists()
    assert Settings.from_scenario(session.scenario).overrides(session.scenario) == ()


@pytest.mark.slow
def test_only_stages_that_depend_on_a_setting_run(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EGVS_STORE", "")  # else it would come from there
    made, make = [], stage_registry.run_stage
    monkeypatch.setattr(
        stage_registry, "run_stage", lambda name, *args, **more: (made.append(name), make(name, *args, **more))[1]
    )
    SessionFactory(session, tmp_path / "scratch").session(Settings(2.5, "egvs", frozenset()))
    assert made == ["score"]


@pytest.mark.slow
def test_plan_with_other_gamma_has_its_joint_score(mini: Path, tmp_path: Path) -> None:
    (mini / "sites.csv").write_text(FOUR_SITES)
    egvs.place(egvs.load(mini, ["placement.count=2"]), tmp_path / "run")
    session = open_session(mini, (), tmp_path / "run")
    tried = SessionFactory(session, tmp_path / "scratch").session(Settings(1.0, "egvs", frozenset()))
    assert session.plan is not None
    assert tried.plan is not None
    assert list(tried.plan.sites) == list(session.plan.sites)
    sites = [tried.candidates[name].site for name in tried.plan.sites]
    hits = sum(tried.hits(site) for site in sites)
    assert tried.plan.joint == pytest.approx(float((tried.entropy_bit * hits.clip(max=1.0)).sum()), rel=1e-9)
    assert tried.plan.joint < session.plan.joint


@pytest.mark.slow
def test_rejects_invalid_settings(session: Session, tmp_path: Path) -> None:
    variants = SessionFactory(session, tmp_path / "scratch")
    with pytest.raises(InputError, match=r"score\.gamma: expected a value greater than or equal to 0 or .*, got -1\.0"):
        variants.session(Settings(-1.0, "egvs", frozenset()))
    with pytest.raises(InputError, match="rated_range_m"):
        variants.session(Settings(None, "egvs", frozenset({"range_limit"})))
    assert variants.session(Settings(2.0, "egvs", frozenset())).scenario.gamma == 2.0


@pytest.mark.slow
def test_offers_effects_that_the_scene_calls_for(mini: Path, tmp_path: Path, session: Session) -> None:
    assert set(offered_effects(session)) == {"divergence", "moving_occlusion"}
    assert trial_parameters("moving_occlusion") == {}
    rainy = open_session(mini, ["effects.rain.rate_mm_h=20"], tmp_path / "rainy")
    assert set(offered_effects(rainy)) == {"divergence", "moving_occlusion", "rain"}
