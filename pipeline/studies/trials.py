"""What does one setting score, and what does each of its stages cost?

Stages run in the order of the program, in a folder of their own; what a stage wrote is kept under the hash of its
inputs, so that settings that share traffic, static world or scans share the work. A stage can be run again, to time it
once more: it must then write the same bytes.

    out/accuracy/<hash of the setting>.json     its scores, so that a study goes on where it was interrupted
    out/accuracy/stages/<stage>-<hash>/         artefacts of a stage; cost.json: seconds of each repeat, memory; of the
    score stage
                                                also left_out.json: scores with each group of blocks left out
"""

from __future__ import annotations

import importlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import tables
from pipeline.artefacts.readers import read_tpog
from pipeline.core import files
from pipeline.core.cost import let_go, measured
from pipeline.core.errors import InputError, RunError
from pipeline.core.progress import Progress
from pipeline.core.version import __version__
from pipeline.runs import stages
from pipeline.scenario.loading import load
from pipeline.scenario.models import Scenario, SiteGrid
from pipeline.scoring.egvs import EntropyField
from pipeline.scoring.uncertainty import Estimate, LeaveOut, order
from pipeline.scoring.visibility import Hits, Visibility
from pipeline.sensing import scanner as survey
from pipeline.sensing import sites
from pipeline.studies.settings import Setting

STAGES = ("statics", "scan", "traffic", "tpog", "score")
"""What a ranking takes; the report is left out."""

_COST, _LEFT_OUT = "cost.json", "left_out.json"
_NOTES = (_COST, _LEFT_OUT)
"""Files beside a stage's artefacts."""


@dataclass(frozen=True)
class Trial:
    """One setting's scores.

    Attributes
    ----------
    sites
        Names, in the order of the sites.
    shares
        Scores as shares of ``egvs_limit`` (of the TPOG's entropy where gamma is infinite), (n,) float64.
    share_ses
        Their standard errors, (n,); not a number where the TPOG has one block.
    frames
        T.
    scores, ses, biases
        In bits, (n,); the last two not a number where the TPOG has one block.
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
    frames: int
    scores: list[float]
    ses: list[float]
    biases: list[float]
    quantile: float
    neighbours: list[tuple[str, str, float, float]]
    stages: dict[str, str]


@dataclass(frozen=True)
class Spent:
    """What one stage cost so far.

    Seconds of each repeat (of the clock, and of all processors), peak of memory above what the program held before it,
    bytes of its artefacts."""

    seconds: tuple[float, ...]
    busy: tuple[float, ...]
    peak_mb: float
    bytes: int


class Bench:
    """Runs settings of one scenario, each stage once for equal inputs."""

    def __init__(self, path: Path, sets: Sequence[str], out: Path, jobs: int | None, progress: Progress) -> None:
        self._path, self._sets, self._jobs, self._progress = path, tuple(sets), jobs, progress
        self._kept = out / "accuracy"
        try:
            (self._kept / "stages").mkdir(parents=True, exist_ok=True)
            for left in self._kept.glob(".work-*"):  # of a study that was killed
                shutil.rmtree(left)
        except OSError as error:
            raise InputError(self._kept, f"is no folder to work in ({error.strerror})", "remove it") from None
        self._results: dict[Setting, Path] = {}

    def scenario(self, setting: Setting) -> Scenario:
        """The scenario as this setting has it."""
        scenario = load(self._path, [*self._sets, *setting.overrides])
        if setting.without is None:
            return scenario
        return scenario.with_effects({name: p for name, p in scenario.effects.items() if name != setting.without})

    def known(self, setting: Setting) -> Trial | None:
        """A kept result; None where there is none, or where a stage's artefacts were removed."""
        path = self._result(setting)
        if not path.is_file():
            return None
        with _as_kept(path):
            trial = _sound(Trial(**_read(path)["trial"]))
            return trial if all(self._is_kept(name, key) for name, key in trial.stages.items()) else None

    def run(self, setting: Setting) -> Trial:
        """Run every stage that is not known yet, and score."""
        if (known := self.known(setting)) is not None:
            return known
        scenario = self.scenario(setting)
        with self._workshop() as work:
            keys = {}
            for name in STAGES:
                keys[name] = stages.inputs(name, scenario, work).key
                if not self._is_kept(name, keys[name]):
                    self._measure(name, keys[name], scenario, work)
                _link(self._folder(name, keys[name]), work)
            left_out = self._folder("score", keys["score"]) / _LEFT_OUT
            with _as_kept(left_out):
                kept = np.array(_read(left_out), dtype=np.float64) if left_out.is_file() else None
                trial = _trial(scenario, work, keys, setting.weight, kept)
        about = {"setting": setting.name, "overrides": setting.overrides, "trial": trial.__dict__}
        files.write_text(self._result(setting), json.dumps(about, indent=1) + "\n")
        return trial

    def again(self, name: str, setting: Setting, trial: Trial) -> None:
        """Run one stage of a known setting once more, for its time; RunError when it writes other bytes."""
        with self._workshop() as work:
            for before in STAGES[: STAGES.index(name)]:
                _link(self._folder(before, trial.stages[before]), work)
            self._measure(name, trial.stages[name], self.scenario(setting), work)

    def warm_up(self, setting: Setting) -> None:
        """Run all stages once, with a single site, and forget it: what is compiled or loaded first is compiled and
        loaded then."""
        scenario = _with_one_site(self.scenario(setting))
        with self._workshop() as work:
            for name in STAGES:
                _module(name).run(scenario, work, jobs=self._jobs)

    def spent(self, name: str, key: str) -> Spent:
        """What one stage cost so far."""
        folder = self._folder(name, key)
        size = sum(path.stat().st_size for path in folder.iterdir() if path.name not in _NOTES)
        with _as_kept(folder / _COST):
            cost = _read(folder / _COST)
            seconds, busy = (tuple(float(value) for value in cost[key]) for key in ("seconds", "busy"))
            if not len(seconds) == len(busy) > 0:
                raise ValueError("no times")
            return Spent(seconds, busy, float(cost["peak_mb"]), size)

    def artefact(self, trial: Trial, stage: str, name: str) -> Path:
        """Where one of a trial's artefacts is kept."""
        return self._folder(stage, trial.stages[stage]) / name

    def hits(self, setting: Setting, trial: Trial) -> Iterator[tuple[Hits, int]]:
        """Hits of each site and their unit, as :meth:`Visibility.hits` gives them."""
        with self._workshop() as work:
            for name in STAGES:
                _link(self._folder(name, trial.stages[name]), work)
            visibility = Visibility(self.scenario(setting), work, read_tpog(work / "tpog.parquet").grid)
            for beams in visibility.beams():
                yield visibility.hits(beams), visibility.unit

    def note(self, name: str) -> dict[str, Any]:
        """Something else that the study keeps."""
        path = self._kept / f"{name}.json"
        with _as_kept(path):
            return dict(_read(path)) if path.is_file() else {}

    def keep_note(self, name: str, value: dict[str, Any]) -> None:
        """Keep it."""
        files.write_text(self._kept / f"{name}.json", json.dumps(value, indent=1) + "\n")

    def _measure(self, name: str, key: str, scenario: Scenario, work: Path) -> None:
        left_out: list[list[float]] = []
        extra = {"left_out": left_out} if name == "score" else {}
        let_go()
        began = _busy_s()
        with measured() as cost:
            _module(name).run(scenario, work, jobs=self._jobs, progress=self._progress, **extra)
        busy_s = _busy_s() - began
        written = [work / artefact for artefact in _module(name).ARTEFACTS if (work / artefact).exists()]
        digests = {path.name: files.sha256_of(path) for path in written}
        folder = self._folder(name, key)
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / _COST
        before: dict[str, Any] = {"seconds": [], "busy": [], "peak_mb": 0.0, "sha256": digests}
        if file.is_file():
            before = _read(file)
        if before["sha256"] != digests:
            raise RunError(f"{name}: a repeat wrote other bytes than the first run; kept in {folder}")
        if not self._is_kept(name, key):
            for path in written:
                (folder / path.name).unlink(missing_ok=True)  # of a study that was interrupted
                _same(path, folder / path.name)
        if left_out:
            files.write_text(folder / _LEFT_OUT, json.dumps(left_out) + "\n")
        now = {
            "seconds": [*before["seconds"], round(cost.seconds, 4)],
            "busy": [*before["busy"], round(busy_s, 4)],
            "peak_mb": max(before["peak_mb"], round(cost.peak_mb - cost.held_mb, 1)),
            "sha256": digests,
        }
        files.write_text(file, json.dumps(now) + "\n")

    def _result(self, setting: Setting) -> Path:
        """Where a setting's result is kept; its files are read once."""
        if setting not in self._results:
            read = {**inputs_of(self.scenario(setting)), "weight": setting.weight}
            self._results[setting] = self._kept / f"{files.hash_of(read)[:16]}.json"
        return self._results[setting]

    def _is_kept(self, name: str, key: str) -> bool:
        """Whether a stage's costs and all of its artefacts are there."""
        folder = self._folder(name, key)
        if not (folder / _COST).is_file():
            return False
        with _as_kept(folder / _COST):
            return all((folder / artefact).is_file() for artefact in _read(folder / _COST)["sha256"])

    def _folder(self, name: str, key: str) -> Path:
        return self._kept / "stages" / f"{name}-{key[:16]}"

    @contextmanager
    def _workshop(self) -> Iterator[Path]:
        with tempfile.TemporaryDirectory(prefix=".work-", dir=self._kept) as folder:
            try:
                yield Path(folder)
            except InputError as error:
                if folder not in str(error):
                    raise
                raise InputError(
                    self._kept, f"holds a damaged artefact ({error})", "remove it, and run the study again"
                ) from None


@contextmanager
def _as_kept(path: Path) -> Iterator[None]:
    """What is read from ``path`` is as the study wrote it; else InputError."""
    try:
        yield
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            path, f"is not as the study wrote it ({error})", "remove it, and run the study again"
        ) from None


def _read(path: Path) -> Any:
    with _as_kept(path):
        return json.loads(path.read_text(encoding="utf-8"))


def _sound(trial: Trial) -> Trial:
    """The trial, if it has a number for each site; else ValueError."""
    for name in ("shares", "share_ses", "scores", "ses", "biases"):
        if np.array(getattr(trial, name), dtype=np.float64).shape != (len(trial.sites),):
            raise ValueError(f"{name} of {len(trial.sites)} sites")
    return trial


def inputs_of(scenario: Scenario) -> dict[str, Any]:
    """Everything that the scores of a scenario depend on: its settings, and its files by hash."""
    return {
        "egvs": __version__,
        "scenario": scenario.model_dump(mode="json"),
        "statics": _module("statics").inputs(scenario, scenario.folder),
        "traffic": _module("traffic").inputs(scenario, scenario.folder),
        "sites": survey.site_files(scenario),
    }


def _with_one_site(scenario: Scenario) -> Scenario:
    """The scenario with the first of its sites alone."""
    site = sites.of(scenario)[0]
    here = SiteGrid(
        low_m=(site.x_m, site.y_m), high_m=(site.x_m, site.y_m), spacing_m=1.0, heights_m=(max(site.z_m, 0.1),)
    )
    alone = {"file": None, "along": (), "points": None, "grid": here, "sensor": site.sensor}
    nothing_kept = scenario.score.model_copy(update={"keep_visibility": ()})
    return scenario.model_copy(update={"sites": scenario.sites.model_copy(update=alone), "score": nothing_kept})


def _busy_s() -> float:
    """Seconds that processors worked for this process and those that it waited for (SUMO): other people's work is not
    in it."""
    return sum(os.times()[:4])


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"pipeline.stages.{name}")


def _link(folder: Path, work: Path) -> None:
    """Lay a stage's kept artefacts into a folder."""
    for path in folder.iterdir():
        if path.name not in _NOTES:
            (work / path.name).unlink(missing_ok=True)
            _same(path, work / path.name)


def _same(path: Path, other: Path) -> None:
    """One file under two names (artefacts are never written into, only replaced); a copy where links are not to be
    had."""
    try:
        os.link(path, other)
    except OSError:
        shutil.copyfile(path, other)


def _trial(
    scenario: Scenario, work: Path, keys: dict[str, str], weight: float, left_out: NDArray[np.float64] | None
) -> Trial:
    """What came of all stages in ``work``; ``left_out`` as the score stage found it, None where the scenario wants no
    errors."""
    table = tables.read(work / "scores.parquet", "scores")[0].to_pydict()
    tpog, gamma = read_tpog(work / "tpog.parquet"), scenario.score.gamma
    names, scores = table["site"], np.array(table["egvs"])
    unit = 1.0 / weight if math.isinf(gamma) else gamma  # a finite gamma is divided by the weight already
    most = EntropyField.of(tpog.counts, tpog.frames, tpog.grid).limit(unit)
    shares = scores / most if most > 0 else np.zeros(len(scores))
    leave_out = LeaveOut.of(work / "tpog.parquet", tpog)
    if leave_out is None:
        unknown = [math.nan] * len(names)
        return Trial(
            names, shares.tolist(), unknown, tpog.frames, scores.tolist(), unknown, unknown, math.nan, [], keys
        )
    if left_out is None:
        visibility = Visibility(scenario, work, tpog.grid)
        left_out = np.array([leave_out.scores(visibility.hits(b), gamma, visibility.unit) for b in visibility.beams()])
    if left_out.shape != (len(names), 1 + len(leave_out.frames)):
        raise ValueError(f"{left_out.shape} numbers")
    limits = leave_out.limits(unit)
    raw = Estimate.of(left_out, leave_out.frames)
    normal = Estimate.of(left_out / np.where(limits > 0, limits, 1.0), leave_out.frames)
    return Trial(
        names, shares.tolist(), normal.se.tolist(), tpog.frames, scores.tolist(), raw.se.tolist(), raw.bias.tolist(),
        raw.quantile(), _neighbours(raw, names, tpog.frames), keys,
    )  # fmt: skip


def _neighbours(estimate: Estimate, names: list[str], frames: int) -> list[tuple[str, str, float, float]]:
    ranked = order(estimate.scores)
    chances = estimate.beats(ranked[:-1], ranked[1:])
    found = []
    for (a, b), chance in zip(pairwise(ranked.tolist()), chances.tolist(), strict=True):
        found.append((names[a], names[b], chance, frames * estimate.times_needed(a, b)))
    return found
