"""Run one setting of a study, and measure what each of its stages costs.

Stages run in the usual order, in a temporary folder. Their artefacts are cached (:mod:`egvs.runs.store`), so settings
that share traffic, static world or scans share the work, with each other and with all other runs. A stage can be run
again to measure its time once more; it must then write the same bytes. Until the study has measured a stage that comes
from the cache, the cost of the run that wrote it counts.

    out/accuracy/<hash of the setting>.json     results of the setting, so that an interrupted study can continue
    out/accuracy/times/<stage>-<key>.json       resource usage of each repeat, hashes of the artefacts
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

from egvs.artefacts.checksums import CHECKSUM_KEY, add_checksum, has_valid_checksum
from egvs.core import files, reading
from egvs.core.errors import InputError, RunError
from egvs.core.progress import ProgressCallback
from egvs.core.resource_usage import ResourceUsage, release_memory
from egvs.runs import stage_keys, stage_registry
from egvs.runs.run import fetch_or_run
from egvs.runs.run_context import open_folder
from egvs.runs.run_sources import SettingsSource
from egvs.runs.stage_keys import StageKey
from egvs.runs.stage_registry import RANKING_STAGES, StageResult
from egvs.runs.store import Store
from egvs.scenario.model import Scenario, SiteGrid
from egvs.sensors import sites
from egvs.stages.base import StageContext
from egvs.stages.scene_dependencies import site_digests
from egvs.studies.study_settings import Setting

STUDY_FOLDER = "accuracy"
"""Subfolder of the run folder for intermediate results."""

SettingListener = Callable[[str, str, dict[str, Any]], None]
"""Called with a setting, its state ("done", "kept" or "skipped"), and its seconds or the reason."""


@dataclass(frozen=True)
class StageTimes:
    """What one stage has cost so far.

    Attributes
    ----------
    seconds, busy_s
        Wall-clock time and processor time of each repeat.
    repeats
        How many times the study has measured the stage; 0 if the cost is that of the run that wrote the artefacts.
    """

    seconds: tuple[float, ...]
    busy_s: tuple[float, ...]
    repeats: int


class SettingRunner:
    """Runs settings of one scenario, and each stage once for equal inputs.

    Parameters
    ----------
    path, overrides
        The scenario and arguments of ``--set``, or a run folder.
    out
        The run folder; intermediate results are written to its subfolder ``accuracy``.
    jobs
        Number of threads; None for all cores.
    progress
        Called by the stages.
    """

    def __init__(
        self, path: Path, overrides: Sequence[str], out: Path, jobs: int | None, progress: ProgressCallback
    ) -> None:
        self._source = SettingsSource(path, tuple(overrides))
        self._jobs, self._progress = jobs, progress
        self._folder, self._store = out / STUDY_FOLDER, Store.default()
        try:
            (self._folder / "times").mkdir(parents=True, exist_ok=True)
            for leftover in self._folder.glob(".work-*"):  # of a study that was killed
                shutil.rmtree(leftover)
        except OSError as error:
            problem = f"cannot be used as a folder for intermediate results ({error.strerror})"
            raise InputError(self._folder, problem, "Remove it.") from None
        self._dependencies: dict[Setting, str] = {}
        self._gamma: float | None = None

    def scenario(self, setting: Setting) -> Scenario:
        """Load the scenario with a setting; gamma is that of the study's scenario unless the setting changes it."""
        if self._gamma is None:
            self._gamma = self._source.load().gamma
        scenario = self._source.load([f"score.gamma={self._gamma}", *setting.overrides])
        if setting.without is None:
            return scenario
        return scenario.with_effects(scenario.effects.without(setting.without))

    def run_stages(self, setting: Setting) -> dict[str, str]:
        """Run the stages that are not cached, and return the key of each stage."""
        with self._temporary_run(self.scenario(setting)) as work:
            return {name: self._ensure_stage(name, work) for name in RANKING_STAGES}

    def measure_stages(self, setting: Setting) -> dict[str, float]:
        """Return the processor seconds of each stage, as this study measures them.

        A stage whose artefacts are from another run is run again: that run may have included compilation.

        Raises
        ------
        RunError
            If a stage writes other bytes than before.
        """
        seconds = {}
        for name, key in self.run_stages(setting).items():
            if not self.stage_times(name, key).repeats:
                self.time_again(name, setting, key)
            seconds[name] = median(self.stage_times(name, key).busy_s)
        return seconds

    def time_again(self, name: str, setting: Setting, key: str) -> None:
        """Run one stage again to measure its time.

        Parameters
        ----------
        name, key
            The stage, and its key.
        setting
            A setting with this stage.

        Raises
        ------
        RunError
            If the stage writes other bytes than before.
        """
        with self._temporary_run(self.scenario(setting), RANKING_STAGES[: RANKING_STAGES.index(name)]) as work:
            result = self._run_stage(name, work, stage_keys.stage_key(name, work))
            self._save_times(name, key, result, is_measured=True)

    @contextmanager
    def open_run(self, setting: Setting, stages: Sequence[str] = RANKING_STAGES[:-1]) -> Iterator[StageContext]:
        """Open a temporary run folder with the artefacts of some stages; by default those before scores."""
        with self._temporary_run(self.scenario(setting), stages) as work:
            yield work

    def saved_result(self, setting: Setting, request: Mapping[str, Any]) -> dict[str, Any] | None:
        """Read what :meth:`save_result` wrote for the same scenario and request; None if there is nothing."""
        path = self._result(setting, request)
        if not path.is_file():
            return None
        with _reject_altered(path):
            result: dict[str, Any] = _read_json(path)["result"]
            return result

    def save_result(self, setting: Setting, request: Mapping[str, Any], result: Mapping[str, Any]) -> None:
        """Save a result of a setting, so that an interrupted study can continue.

        Parameters
        ----------
        setting
            The setting.
        request
            What else the result depends on.
        result
            A JSON value.
        """
        _write_json(self._result(setting, request), {"setting": setting.name, "result": dict(result)})

    @contextmanager
    def reject_altered(self, setting: Setting, request: Mapping[str, Any]) -> Iterator[None]:
        """Raise an InputError that names the file of a result if it cannot be understood."""
        with _reject_altered(self._result(setting, request)):
            yield

    def warm_up(self, setting: Setting) -> None:
        """Run all stages with a single site and discard the result, so that everything is compiled and loaded."""
        with self._temporary_run(with_one_site(self.scenario(setting))) as work:
            for name in RANKING_STAGES:
                stage_registry.run_stage(name, work, stage_keys.stage_key(name, work).dependencies)

    def stage_times(self, name: str, key: str) -> StageTimes:
        """Return what a stage has cost so far."""
        path = self._times(name, key)
        with _reject_altered(path):
            times = _read_json(path)
            costs = [ResourceUsage(**cost) for cost in times["measured"] or [times["made"]]]
            seconds = tuple(float(cost.seconds) for cost in costs)
            busy_s = tuple(float(cost.busy_s) for cost in costs)
            return StageTimes(seconds, busy_s, len(times["measured"]))

    def median_seconds(self, keys: Mapping[str, str]) -> dict[str, float]:
        """Return the median wall-clock time of each stage."""
        return {name: median(self.stage_times(name, keys[name]).seconds) for name in RANKING_STAGES}

    def _ensure_stage(self, name: str, work: StageContext) -> str:
        """Fetch or run a stage in a folder with the stages before it, and return its key."""
        inputs = stage_keys.stage_key(name, work)
        result, is_cached = fetch_or_run(
            name, work, inputs.key, self._store, lambda: self._run_stage(name, work, inputs), link=True
        )
        if not (is_cached and self._times(name, inputs.key).is_file()):
            self._save_times(name, inputs.key, result, is_measured=not is_cached)
        return inputs.key

    @staticmethod
    def _run_stage(name: str, work: StageContext, inputs: StageKey) -> StageResult:
        release_memory()
        return stage_registry.run_stage(name, work, inputs.dependencies)

    def _save_times(self, name: str, key: str, result: StageResult, *, is_measured: bool) -> None:
        """Add the cost of a stage, measured now or by the run that wrote the artefacts."""
        path = self._times(name, key)
        cost = asdict(result.cost)
        times: dict[str, Any] = {"made": cost, "measured": [], "sha256": result.artefacts}
        with _reject_altered(path):
            if path.is_file():
                times = _read_json(path)
            if times["sha256"] != result.artefacts:
                raise RunError(
                    f"{name}: the repeated run wrote bytes that differ from those of the first run. See {path}"
                )
            if is_measured:
                times["measured"].append(cost)
        _write_json(path, times)

    def _result(self, setting: Setting, request: Mapping[str, Any]) -> Path:
        """Return the file with a result of a setting; the scenario's files are hashed once for it."""
        if setting not in self._dependencies:
            self._dependencies[setting] = files.hash_json(scenario_dependencies(self.scenario(setting)))
        name = files.hash_json({"dependencies": self._dependencies[setting], "request": dict(request)})
        return self._folder / f"{name[:16]}.json"

    def _times(self, name: str, key: str) -> Path:
        return self._folder / "times" / f"{name}-{key[:16]}.json"

    @contextmanager
    def _temporary_run(self, scenario: Scenario, ready: Sequence[str] = ()) -> Iterator[StageContext]:
        """Open a temporary run folder with the artefacts of the stages ``ready``."""
        with tempfile.TemporaryDirectory(prefix=".work-", dir=self._folder) as folder:
            work = open_folder(scenario, Path(folder), jobs=self._jobs, progress=self._progress)
            for name in ready:
                self._ensure_stage(name, work)
            yield work


@contextmanager
def _reject_altered(path: Path) -> Iterator[None]:
    """Raise an InputError if the content of ``path`` is not as the study wrote it."""
    try:
        yield
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        problem = f"was changed after the study wrote it ({error})"
        raise InputError(path, problem, "Remove it, and run the study again.") from None


def _read_json(path: Path) -> dict[str, Any]:
    """Read what :func:`_write_json` wrote; ValueError for anything else."""
    value = reading.read_json(path, "Remove it, and run the study again.")
    if not has_valid_checksum(value):
        raise ValueError("its own_sha256 does not match its content")
    return {key: part for key, part in value.items() if key != CHECKSUM_KEY}


def _write_json(path: Path, value: dict[str, Any]) -> None:
    files.write_text(path, json.dumps(add_checksum(value), indent=1) + "\n")


def scenario_dependencies(scenario: Scenario) -> dict[str, Any]:
    """Return everything that the scores of a scenario depend on: its settings, its files by hash, and the program."""
    work = open_folder(scenario, scenario.folder)
    return {
        "scenario": scenario.model_dump(mode="json"),
        "stages": {name: stage_keys.stage_key(name, work).key for name in ("statics", "traffic")},
        "sites": site_digests(scenario, sites.candidate_sites(scenario)),
        "program": {name: stage_keys.program_inputs(name, scenario) for name in RANKING_STAGES},
    }


def with_one_site(scenario: Scenario) -> Scenario:
    """Return the scenario with only the first of its sites."""
    site = sites.candidate_sites(scenario)[0]
    xy_m = (site.pose.x_m, site.pose.y_m)
    grid = SiteGrid(low_m=xy_m, high_m=xy_m, spacing_m=1.0, heights_m=(max(site.pose.z_m, 0.1),))
    yaw_deg, pitch_deg, roll_deg = site.pose.angles_deg
    changes = {
        "file": None, "along": (), "points": None, "grid": grid, "sensor": site.sensor, "heights_m": (), "aim": None,
        "aim_m": None, "yaw_deg": yaw_deg, "pitch_deg": pitch_deg, "roll_deg": roll_deg, "only_free": False,
    }  # fmt: skip
    score = scenario.score.model_copy(update={"keep_visibility": ()})
    return scenario.model_copy(update={"sites": scenario.sites.model_copy(update=changes), "score": score})
