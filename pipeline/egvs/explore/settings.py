"""Sessions of the explorer: opened from a run or a scenario, and with other settings (gamma, score, effects).

A session with other settings is a run of its own, with the numbers of ``egvs run --set``. It runs in a temporary folder
that exists as long as the page; stages that the settings do not change are copied from the explored run.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egvs.artefacts.run_folder import RunFolder
from egvs.core.progress import ProgressCallback, no_progress
from egvs.effects import registry
from egvs.explore.session import Session
from egvs.runs import run, stage_registry
from egvs.runs.run import StageListener, ignore_stage, lock_run_folder
from egvs.runs.run_context import open_folder
from egvs.runs.run_sources import SettingsSource
from egvs.scenario.loading import scenario_from_dict
from egvs.scenario.model import Scenario
from egvs.studies import effect_study

REQUIRED_STAGES = ("check", "statics", "scan", "traffic", "tpog", "score")
"""Stages whose artefacts a session reads."""

_OFFERED_STATES = ("on", "skipped", "called for")


@dataclass(frozen=True)
class Settings:
    """Settings that can be changed on the page.

    Attributes
    ----------
    gamma
        None for the scenario's.
    rank_by
        The score that ranks.
    effects
        Names of active effects.
    """

    gamma: float | None
    rank_by: str
    effects: frozenset[str]

    @classmethod
    def from_scenario(cls, scenario: Scenario) -> Settings:
        """Return the settings of a scenario."""
        return cls(None, scenario.score.rank_by, frozenset(scenario.effects.named))

    def apply(self, scenario: Scenario, where: str = "") -> Scenario:
        """Return a scenario with these settings.

        Parameters
        ----------
        scenario
            The scenario.
        where
            Used in messages instead of the scenario's file.

        Raises
        ------
        InputError
            If a setting is not valid.
        """
        if self == Settings.from_scenario(scenario):
            return scenario
        values = scenario.model_dump(mode="json")
        if self.gamma is not None:
            values["score"]["gamma"] = "inf" if math.isinf(self.gamma) else self.gamma
        values["score"]["rank_by"] = self.rank_by
        named = values["effects"]
        values["effects"] = {name: named.get(name) or trial_parameters(name) for name in sorted(self.effects)}
        if registry.LOSSES not in self.effects and scenario.effects.range_limit is not None:
            values["effects"][registry.LOSSES] = False  # without it, losses would act by themselves
        return scenario_from_dict(values, scenario.folder, where or str(scenario.file))

    def overrides(self, scenario: Scenario) -> tuple[str, ...]:
        """Return the differences from a scenario as arguments of ``egvs run --set``."""
        unchanged = Settings.from_scenario(scenario)
        overrides = []
        if self.gamma is not None:
            overrides.append(f"score.gamma={self.gamma:g}")
        if self.rank_by != unchanged.rank_by:
            overrides.append(f"score.rank_by={self.rank_by}")
        for name in sorted(self.effects - unchanged.effects):
            parameters = ", ".join(f"{key}={value}" for key, value in trial_parameters(name).items())
            overrides.append(f"effects.{name}={{{parameters}}}")
        for name in sorted(unchanged.effects - self.effects):
            overrides.append("effects.range_limit=false" if name == registry.LOSSES else f"without effects.{name}")
        return tuple(overrides)


def trial_parameters(effect: str) -> dict[str, Any]:
    """Return the parameters with which an effect is tried if the scenario does not name it."""
    return dict(registry.load_effect_class(effect).TRIAL)


def offered_effects(session: Session) -> dict[str, str]:
    """Return the effects that the scenario names or that its scene calls for, with the reason."""
    named = session.scenario.effects.named
    offered = {}
    for status in effect_study.effect_statuses_in_scene(session.scene):
        acts_by_itself = status.name == registry.LOSSES and status.name not in named
        if status.state not in _OFFERED_STATES or acts_by_itself:
            continue
        if status.name in named or not registry.load_effect_class(status.name).USER_KNOWLEDGE:
            offered[status.name] = status.why
    return offered


def make_session(
    scenario: Scenario, folder: Path, *, jobs: int | None = None, progress: ProgressCallback = no_progress,
    listener: StageListener = ignore_stage,
) -> Session:  # fmt: skip
    """Open a session over a scenario; stages that are not up to date run first.

    Parameters
    ----------
    scenario
        The scenario.
    folder
        Its run folder.
    jobs
        Number of threads; None for all cores.
    progress, listener
        Called as stages proceed, and when they end.
    """
    record = run.run(scenario, folder, only=REQUIRED_STAGES, jobs=jobs, progress=progress, listener=listener)
    with lock_run_folder(folder):
        work = open_folder(scenario, folder, jobs=jobs, recorded=stage_registry.recorded_digests(record))
        return Session(work, {name: stage.inputs for name, stage in record.stages.items()})


class SessionFactory:
    """Makes sessions of one run with other settings.

    Parameters
    ----------
    session
        The session without changes.
    scratch
        A temporary folder.
    """

    def __init__(self, session: Session, scratch: Path) -> None:
        self._initial_session, self._folder = session, scratch / "run"

    def session(self, settings: Settings, progress: ProgressCallback = no_progress) -> Session:
        """Return the session with some settings.

        Parameters
        ----------
        settings
            The settings.
        progress
            Called as stages proceed.

        Raises
        ------
        InputError
            If a run would reject them.
        """
        initial = self._initial_session
        scenario = settings.apply(initial.scenario)
        if scenario is initial.scenario:
            return initial
        if not RunFolder(self._folder).run_record.is_file():
            _copy_run(initial.work.folder.path, self._folder)
        return make_session(scenario, self._folder, jobs=initial.work.threads, progress=progress)


def _copy_run(source: Path, folder: Path) -> None:
    """Copy the artefacts of the stages and of ``egvs place``.

    The record is copied last, so that it never names missing files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = [name for stage in REQUIRED_STAGES for name in stage_registry.written_by(stage)]
    names += [RunFolder.placement.name, RunFolder.curve.name, RunFolder.placement_checksums.name]
    names.append(RunFolder.run_record.name)
    with lock_run_folder(source):
        for name in names:
            path = source / name
            if path.is_dir():
                shutil.copytree(path, folder / name, dirs_exist_ok=True)
            elif path.is_file():
                shutil.copyfile(path, folder / name)


def open_session(
    path: str | Path,
    overrides: Sequence[str] = (),
    out: str | Path | None = None,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: StageListener = ignore_stage,
) -> Session:
    """Open a session over a run folder or a scenario; stages that are not up to date run first.

    Parameters
    ----------
    path
        A folder with a ``run.json``, or a scenario.
    overrides, out
        For a scenario only: arguments of ``--set``, and its run folder.
    jobs
        Number of threads; None for all cores.
    progress, listener
        Called as stages proceed, and when they end.

    Raises
    ------
    InputError
        If it is neither, the scenario is not valid, or a run folder is given together with overrides or ``out``.
    """
    run_folder = None if out is None else Path(out)
    source = SettingsSource.of(Path(path), overrides, run_folder)
    scenario = source.load()
    return make_session(
        scenario, source.folder(scenario, run_folder), jobs=jobs, progress=progress, listener=listener
    )  # fmt: skip
