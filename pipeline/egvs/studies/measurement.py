"""One setting of a study is run: what it scores, and what each of its stages costs.

Stages run in the order of the program, in a folder of their own. What a stage wrote is in the store
(:mod:`egvs.runs.store`), so that settings that share traffic, static world or scans share the work, with each other
and with every other run. Times are the study's own: a stage can be run again, to time it once more; it must then write
the same bytes. A stage that was fetched counts with what it cost whoever made it, until it is timed here.

    out/accuracy/<hash of the setting>.json     its scores, so that a study goes on where it was interrupted
    out/accuracy/times/<stage>-<key>.json       seconds of each repeat, memory, hashes of what it wrote
"""

from __future__ import annotations

import json
import math
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.tpog import Tpog, read_tpog
from egvs.core import files, reading
from egvs.core.errors import InputError, RunError
from egvs.core.files import CHECKSUM_KEY, add_checksum, has_valid_checksum
from egvs.core.runtime import ProgressCallback, ResourceUsage, release_memory
from egvs.runs import stages
from egvs.runs.run import fetch_or_run
from egvs.runs.stages import RANKING_STAGES, StageKey, StageResult
from egvs.runs.store import Store
from egvs.scenario.loading import load
from egvs.scenario.model import Scenario, SiteGrid
from egvs.scoring.egvs import EntropyField
from egvs.scoring.score_table import MIX, ScoreColumn, ScoreTable, SiteScores
from egvs.scoring.scorer import Scorer
from egvs.scoring.standard_errors import BlockJackknife, ScoreUncertainty, rank_order
from egvs.scoring.target_scores import TARGET_SCORES
from egvs.sensors import sites
from egvs.stages.base import StageContext
from egvs.stages.inputs import get_scene, open_folder
from egvs.stages.scene_inputs import site_digests
from egvs.stages.site_scans import empty_scans
from egvs.stages.site_scoring import ScoredSite, TargetScorer
from egvs.studies.study_settings import Setting, counted_frames

STUDY_FOLDER = "accuracy"
"""In the run's folder, where results are kept."""

SettingListener = Callable[[str, str, dict[str, Any]], None]
"""Called with (setting, "done" | "kept" | "skipped", its seconds, or why it was skipped) as a study goes on."""


@dataclass(frozen=True)
class SettingScores:
    """One setting's scores.

    Attributes
    ----------
    sites
        Names, in the order of the sites.
    shares
        Scores as shares of ``egvs_limit`` (of the TPOG's entropy where gamma is infinite), (n,) float64; where another
        score than the EGVS ranks, its values.
    share_ses
        Their standard errors, (n,); not a number where the TPOG has one block.
    scores, ses, biases
        Of the score that ranks, (n,); the last two not a number where the TPOG has one block.
    quantile
        How many standard errors an interval reaches to each side.
    neighbours
        For each site but the last, best first: its name, the next one's, the chance that it truly scores higher, and
        the frames that would tell the two apart.
    stages
        Stage -> hash of its inputs.
    """

    sites: list[str]
    shares: list[float]
    share_ses: list[float]
    scores: list[float]
    ses: list[float]
    biases: list[float]
    quantile: float
    neighbours: list[tuple[str, str, float, float]]
    stages: dict[str, str]


@dataclass(frozen=True)
class StageTimes:
    """What one stage cost so far.

    Attributes
    ----------
    seconds, busy_s
        Of each repeat: of the clock, and of all processors.
    peak_mb
        Peak of memory above what the program held before.
    bytes
        Of the stage's artefacts.
    repeats
        How many of the times were measured by the study; 0 where the only one is of the run that made the stage.
    """

    seconds: tuple[float, ...]
    busy_s: tuple[float, ...]
    peak_mb: float
    bytes: int
    repeats: int


class SettingRunner:
    """Runs settings of one scenario, each stage once for equal inputs."""

    def __init__(
        self, path: Path, sets: Sequence[str], out: Path, jobs: int | None, progress: ProgressCallback
    ) -> None:
        self._path, self._sets, self._jobs, self._progress = path, tuple(sets), jobs, progress
        self._folder, self._store = out / STUDY_FOLDER, Store.default()
        try:
            (self._folder / "times").mkdir(parents=True, exist_ok=True)
            for left in self._folder.glob(".work-*"):  # of a study that was killed
                shutil.rmtree(left)
        except OSError as error:
            raise InputError(self._folder, f"is no folder to work in ({error.strerror})", "remove it") from None
        self._results: dict[Setting, Path] = {}
        self._gamma: float | None = None

    def scenario(self, setting: Setting) -> Scenario:
        """The scenario as this setting has it; gamma stays the number that the study's own scenario has, unless the
        setting names another."""
        if self._gamma is None:
            self._gamma = load(self._path, self._sets).gamma
        scenario = load(self._path, [*self._sets, f"score.gamma={self._gamma}", *setting.overrides])
        if setting.without is None:
            return scenario
        return scenario.with_effects(scenario.effects.without(setting.without))

    def known(self, setting: Setting) -> SettingScores | None:
        """A kept result; None where there is none, or where a stage's times were removed."""
        path = self._result(setting)
        if not path.is_file():
            return None
        with _check_unaltered(path):
            scores = _checked_scores(SettingScores(**_read_json(path)["scores"]))
            return scores if all(self._times(name, key).is_file() for name, key in scores.stages.items()) else None

    def run(self, setting: Setting) -> SettingScores:
        """Bring every stage that is not known yet, and score."""
        if (known := self.known(setting)) is not None:
            return known
        scored: list[ScoredSite] = []
        with self._workshop(self.scenario(setting)) as work:
            keys = {name: self._ensure_stage(name, work, scored.append) for name in RANKING_STAGES}
            scores = _collect_scores(work, keys, setting.weight, scored)
        about = {"setting": setting.name, "overrides": setting.overrides, "scores": scores.__dict__}
        _write_json(self._result(setting), about)
        return scores

    def time_again(self, name: str, setting: Setting, scores: SettingScores) -> None:
        """Run one stage of a known setting once more, for its time; RunError when it writes other bytes."""
        with self._workshop(self.scenario(setting), RANKING_STAGES[: RANKING_STAGES.index(name)]) as work:
            made = self._make(name, work, stages.stage_key(name, work))
            self._note_times(name, scores.stages[name], work, made, measured=True)

    def warm_up(self, setting: Setting) -> None:
        """Run all stages once, with a single site, and forget it, so that nothing is compiled or loaded later."""
        with self._workshop(_with_one_site(self.scenario(setting))) as work:
            for name in RANKING_STAGES:
                stages.run_stage(name, work, stages.stage_key(name, work).dependencies)

    def times(self, name: str, key: str) -> StageTimes:
        """What one stage cost so far."""
        path = self._times(name, key)
        with _check_unaltered(path):
            kept = _read_json(path)
            costs = [ResourceUsage(**cost) for cost in kept["measured"] or [kept["made"]]]
            seconds, busy_s = tuple(float(c.seconds) for c in costs), tuple(float(c.busy_s) for c in costs)
            peak_mb = max(round(cost.peak_mb - cost.held_mb, 1) for cost in costs)
            return StageTimes(seconds, busy_s, peak_mb, int(kept["bytes"]), len(kept["measured"]))

    def medians(self, scores: SettingScores) -> dict[str, float]:
        """Seconds of each stage."""
        return {name: median(self.times(name, scores.stages[name]).seconds) for name in RANKING_STAGES}

    def tpog(self, setting: Setting) -> Tpog:
        """The TPOG of a setting."""
        with self._workshop(self.scenario(setting), RANKING_STAGES[: RANKING_STAGES.index("tpog") + 1]) as work:
            return read_tpog(work.folder.tpog)

    def scores_against(self, setting: Setting, tpog: Tpog) -> list[float]:
        """What the scans of a setting score against another TPOG on its grid, in the order of the sites."""
        with self._workshop(self.scenario(setting), RANKING_STAGES) as work:
            scorer = Scorer(get_scene(work), tpog, work.folder.trajectories)
            return [scorer.score(scan.beams).egvs for scan in empty_scans(work)]

    def note(self, name: str) -> dict[str, Any]:
        """Something else that the study keeps."""
        path = self._folder / f"{name}.json"
        with _check_unaltered(path):
            return _read_json(path) if path.is_file() else {}

    def save_note(self, name: str, value: dict[str, Any]) -> None:
        """Keep it."""
        _write_json(self._folder / f"{name}.json", value)

    def _ensure_stage(self, name: str, work: StageContext, observe: Callable[[ScoredSite], None] | None = None) -> str:
        """A stage's artefacts into a workshop that holds those before, from the store where it has them; its key.

        ``observe`` hears of each site where the score stage had to be made.
        """
        inputs = stages.stage_key(name, work)
        made, fetched = fetch_or_run(
            name, work, inputs.key, self._store, lambda: self._make(name, work, inputs, observe), link=True
        )
        if not (fetched and self._times(name, inputs.key).is_file()):
            self._note_times(name, inputs.key, work, made, measured=not fetched)
        return inputs.key

    def _make(
        self, name: str, work: StageContext, inputs: StageKey, observe: Callable[[ScoredSite], None] | None = None
    ) -> StageResult:
        release_memory()
        extra = {"observe": observe} if name == "score" and observe is not None else {}
        return stages.run_stage(name, work, inputs.dependencies, **extra)

    def _note_times(self, name: str, key: str, work: StageContext, made: StageResult, *, measured: bool) -> None:
        """Add what a stage cost: measured here, or by whoever made it."""
        path = self._times(name, key)
        size, cost = sum(work.path(name).stat().st_size for name in made.artefacts), asdict(made.cost)
        with _check_unaltered(path):
            first: dict[str, Any] = {"made": cost, "measured": [], "bytes": size, "sha256": made.artefacts}
            kept = _read_json(path) if path.is_file() else first
            if kept["sha256"] != made.artefacts:
                raise RunError(f"{name}: a repeat wrote other bytes than the first run; see {path}")
            if measured:
                kept["measured"].append(cost)
        _write_json(path, kept)

    def _result(self, setting: Setting) -> Path:
        """Where a setting's result is kept; the scenario's files are read once for it."""
        if setting not in self._results:
            read = {**scenario_dependencies(self.scenario(setting)), "weight": setting.weight}
            self._results[setting] = self._folder / f"{files.hash_json(read)[:16]}.json"
        return self._results[setting]

    def _times(self, name: str, key: str) -> Path:
        return self._folder / "times" / f"{name}-{key[:16]}.json"

    @contextmanager
    def _workshop(self, scenario: Scenario, ready: Sequence[str] = ()) -> Iterator[StageContext]:
        """A folder to run a scenario in, where the artefacts of the stages ``ready`` lie."""
        with tempfile.TemporaryDirectory(prefix=".work-", dir=self._folder) as folder:
            work = open_folder(scenario, Path(folder), jobs=self._jobs, progress=self._progress)
            for name in ready:
                self._ensure_stage(name, work)
            yield work


@contextmanager
def _check_unaltered(path: Path) -> Iterator[None]:
    """What is read from ``path`` is as the study wrote it; else InputError."""
    try:
        yield
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        found = f"is not as the study wrote it ({error})"
        raise InputError(path, found, "remove it, and run the study again") from None


def _read_json(path: Path) -> dict[str, Any]:
    """What :func:`_write_json` wrote; ValueError for anything else."""
    value = reading.read_json(path, "remove it, and run the study again")
    if not has_valid_checksum(value):
        raise ValueError("its own_sha256 is of other content")
    return {key: part for key, part in value.items() if key != CHECKSUM_KEY}


def _write_json(path: Path, value: dict[str, Any]) -> None:
    files.write_text(path, json.dumps(add_checksum(value), indent=1) + "\n")


def _checked_scores(scores: SettingScores) -> SettingScores:
    """The scores, if there is a number for each site; else ValueError."""
    for name in ("shares", "share_ses", "scores", "ses", "biases"):
        if np.array(getattr(scores, name), dtype=np.float64).shape != (len(scores.sites),):
            raise ValueError(f"{name} of {len(scores.sites)} sites")
    return scores


def scenario_dependencies(scenario: Scenario) -> dict[str, Any]:
    """Everything that the scores of a scenario depend on: its settings, its files by hash, and the program."""
    work = open_folder(scenario, scenario.folder)
    return {
        "scenario": scenario.model_dump(mode="json"),
        "stages": {name: stages.stage_key(name, work).key for name in ("statics", "traffic")},
        "sites": site_digests(scenario, sites.candidate_sites(scenario)),
        "program": {name: stages.program_inputs(name, scenario) for name in RANKING_STAGES},
    }


def _with_one_site(scenario: Scenario) -> Scenario:
    """The scenario with the first of its sites alone."""
    site = sites.candidate_sites(scenario)[0]
    at_m = (site.pose.x_m, site.pose.y_m)
    here = SiteGrid(low_m=at_m, high_m=at_m, spacing_m=1.0, heights_m=(max(site.pose.z_m, 0.1),))
    yaw_deg, pitch_deg, roll_deg = site.pose.angles_deg
    alone = {
        "file": None, "along": (), "points": None, "grid": here, "sensor": site.sensor, "heights_m": (), "aim": None,
        "aim_m": None, "yaw_deg": yaw_deg, "pitch_deg": pitch_deg, "roll_deg": roll_deg, "only_free": False,
    }  # fmt: skip
    nothing_kept = scenario.score.model_copy(update={"keep_visibility": ()})
    return scenario.model_copy(update={"sites": scenario.sites.model_copy(update=alone), "score": nothing_kept})


def _collect_scores(work: StageContext, keys: dict[str, str], weight: float, scored: list[ScoredSite]) -> SettingScores:
    """What came of all stages, by the score that ranks; ``scored`` are the sites as the score stage scored them, none
    where it was fetched."""
    rank_by = work.scenario.score.rank_by
    table = parquet.read_artefact(work.folder.scores, "scores")[0].to_pydict()
    tpog, gamma = read_tpog(work.folder.tpog), work.scenario.gamma
    names, scores = table["site"], np.array(table[rank_by])
    leave_out = BlockJackknife.of(work.folder.tpog, tpog)
    shares, limits = scores, np.ones(1)
    if rank_by == "egvs":
        unit = 1.0 / weight if math.isinf(gamma) else gamma  # a finite gamma is divided by the weight already
        most = EntropyField.of(tpog.counts, tpog.frames, tpog.grid).limit(unit)
        shares = scores / most if most > 0 else np.zeros(len(scores))
        limits = leave_out.limits(unit) if leave_out is not None else limits
    judged = _score_column(work, tpog, leave_out, scored) if leave_out is not None else None
    if judged is None or judged.left_out is None or (raw := judged.estimate) is None:
        unknown = [math.nan] * len(names)
        return SettingScores(names, shares.tolist(), unknown, scores.tolist(), unknown, unknown, math.nan, [], keys)
    normal = ScoreUncertainty.of(judged.left_out / np.where(limits > 0, limits, 1.0), judged.groups)
    return SettingScores(
        names, shares.tolist(), normal.se.tolist(), scores.tolist(), raw.se.tolist(), raw.bias.tolist(),
        raw.quantile(), _neighbours(raw, names, counted_frames(work.scenario)), keys,
    )  # fmt: skip


def _score_column(work: StageContext, tpog: Tpog, leave_out: BlockJackknife, scored: list[ScoredSite]) -> ScoreColumn:
    """The sites by the score that ranks, with groups of traffic left out, whatever the scenario says of errors."""
    wanted = work.scenario.score
    if scored and wanted.standard_error:
        scores = [SiteScores(site.site.name, site.score, site.targets) for site in scored]
        return ScoreTable.of(scores, {MIX: leave_out.groups}).column(wanted.rank_by)
    with_errors = {"score": wanted.model_copy(update={"standard_error": True})}
    again = open_folder(work.scenario.model_copy(update=with_errors), work.folder.path)
    scorer = Scorer(get_scene(again), tpog, again.folder.trajectories, leave_out)
    targets = TargetScorer(again, tpog.grid) if wanted.rank_by in TARGET_SCORES else None
    scores = []
    for scan in empty_scans(again):
        visible = targets.scores(targets.visible(scan.beams)) if targets is not None else None
        scores.append(SiteScores(scan.site.name, scorer.score(scan.beams), visible))
    return ScoreTable.of(scores, {MIX: leave_out.groups}).column(wanted.rank_by)


def _neighbours(estimate: ScoreUncertainty, names: list[str], frames: int) -> list[tuple[str, str, float, float]]:
    ranked = rank_order(estimate.scores)
    chances = estimate.beats(ranked[:-1], ranked[1:]).tolist()
    pairs = zip(pairwise(ranked.tolist()), chances, strict=True)
    return [(names[a], names[b], chance, frames * estimate.times_needed(a, b)) for (a, b), chance in pairs]
