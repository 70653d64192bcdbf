"""Gamma, score, effects changed on the page; opening a run.

What a planner sets otherwise while sensors are moved: gamma, the score that ranks, effects.

A setting is a run of its own, as ``egvs run --set`` makes it, so that its numbers are those of such a run. It is made
in a folder that goes with the page; stages that the setting does not touch are taken over from the run that is
explored.

Opens a run's folder or a scenario for exploring: what is not up to date is made first, as ``egvs run`` does.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.core.errors import InputError
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.effects import registry
from egvs.explore.session import Session
from egvs.runs import run, stages
from egvs.runs.run import StageListener, ignore_stage, lock_run_folder
from egvs.scenario.loading import load, scenario_from_dict
from egvs.scenario.model import Scenario
from egvs.stages.inputs import open_folder
from egvs.studies import effect_study

REQUIRED_STAGES = ("check", "statics", "scan", "traffic", "tpog", "score")
"""The stages that a session reads."""

_OFFERED_STATES = ("on", "skipped", "called for")


@dataclass(frozen=True)
class Settings:
    """What is set.

    Attributes
    ----------
    gamma
        None: as the scenario has it.
    rank_by
        The score that ranks.
    effects
        Names of those that are on.
    """

    gamma: float | None
    rank_by: str
    effects: frozenset[str]

    @classmethod
    def of(cls, scenario: Scenario) -> Settings:
        """Those of a scenario as it is."""
        return cls(None, scenario.score.rank_by, frozenset(scenario.effects.named))

    def applied_to(self, scenario: Scenario, where: str = "") -> Scenario:
        """The scenario with these settings; InputError, naming ``where`` or its file, where one of them is wrong."""
        if self == Settings.of(scenario):
            return scenario
        values = scenario.model_dump(mode="json")
        if self.gamma is not None:
            values["score"]["gamma"] = "inf" if math.isinf(self.gamma) else self.gamma
        values["score"]["rank_by"] = self.rank_by
        named = values["effects"]
        values["effects"] = {
            name: named[name] if name in named else trial_parameters(name) for name in sorted(self.effects)
        }
        return scenario_from_dict(values, scenario.folder, where or str(scenario.file))

    def in_words(self, scenario: Scenario) -> tuple[str, ...]:
        """What ``egvs run --set`` takes for them, one a setting that is another than the scenario's."""
        own, said = Settings.of(scenario), []
        if self.gamma is not None:
            said.append(f"score.gamma={self.gamma:g}")
        if self.rank_by != own.rank_by:
            said.append(f"score.rank_by={self.rank_by}")
        more, less = sorted(self.effects - own.effects), sorted(own.effects - self.effects)
        said += [
            f"effects.{name}={{{', '.join(f'{k}={v}' for k, v in trial_parameters(name).items())}}}" for name in more
        ]
        return (*said, *(f"without effects.{name}" for name in less))


def trial_parameters(effect: str) -> dict[str, Any]:
    """The parameters of an effect that the scenario does not name: those that it is tried with."""
    return dict(registry.find_effect_class(effect).TRIAL)


def offered_effects(session: Session) -> dict[str, str]:
    """The effects that a scenario names or that its scene calls for, and why."""
    calls = effect_study.effect_statuses_in_scene(session.scene)
    found = {call.name: call.why for call in calls if call.state in _OFFERED_STATES}
    named = session.scenario.effects.named
    return {
        name: why for name, why in found.items() if name in named or not registry.find_effect_class(name).DECIDED_BY
    }


def make_session(
    scenario: Scenario, folder: Path, *, jobs: int | None = None, progress: ProgressCallback = no_progress, **more: Any
) -> Session:
    """A session over a scenario in a run's folder; what is not up to date there is made first."""
    record = run.run(scenario, folder, only=REQUIRED_STAGES, jobs=jobs, progress=progress, **more)
    with lock_run_folder(folder):
        work = open_folder(scenario, folder, jobs=jobs, recorded=stages.recorded_digests(record))
        return Session(work, {name: stage.inputs for name, stage in record.stages.items()})


class SessionFactory:
    """The run that is explored, and what it would be with other settings.

    Parameters
    ----------
    session
        As it was opened; it is the one without other settings.
    scratch
        A folder that goes with the page.
    """

    def __init__(self, session: Session, scratch: Path) -> None:
        self._initial_session, self._folder = session, scratch / "run"

    @property
    def scenario(self) -> Scenario:
        """As it was opened."""
        return self._initial_session.scenario

    def session(self, settings: Settings, progress: ProgressCallback = no_progress) -> Session:
        """The session with some settings.

        Raises
        ------
        InputError
            Where a run with them would be refused.
        """
        scenario = settings.applied_to(self.scenario)
        if scenario is self.scenario:
            return self._initial_session
        if not RunFolder(self._folder).run_record.is_file():
            _copy_outputs(self._initial_session.work.folder.path, self._folder)
        return make_session(scenario, self._folder, jobs=self._initial_session.work.threads, progress=progress)


def _copy_outputs(run: Path, folder: Path) -> None:
    """Copy what stages and ``egvs place`` wrote; the record comes last, so that it is never of files that are not
    there."""
    folder.mkdir(parents=True, exist_ok=True)
    made = [name for stage in REQUIRED_STAGES for name in stages.written_by(stage)]
    with lock_run_folder(run):
        for path in (
            run / name
            for name in (
                *made,
                RunFolder.placement.name,
                RunFolder.curve.name,
                RunFolder.placement_checksums.name,
                RunFolder.run_record.name,
            )
        ):
            if path.is_dir():
                shutil.copytree(path, folder / path.name, dirs_exist_ok=True)
            elif path.is_file():
                shutil.copyfile(path, folder / path.name)


def open_session(
    path: Path,
    sets: Sequence[str] = (),
    out: Path | None = None,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: StageListener = ignore_stage,
) -> Session:
    """A session over the folder of a run, or over a scenario's.

    Parameters
    ----------
    path
        A folder with a ``run.json``, or a scenario.
    sets, out
        Of a scenario: values laid over it, and the run's folder.

    Raises
    ------
    InputError
        When it is neither, or the scenario is wrong.
    """
    if RunFolder(path).run_record.is_file():
        given = "--set" if sets else "--out" if out is not None else None
        if given is not None:
            raise InputError(given, f"with the folder of a run, {path}", f"a scenario, or no {given}")
        scenario, folder = _recorded_scenario(path), path
    else:
        scenario = load(path, sets)
        folder = out or run.default_folder(scenario)
    return make_session(scenario, folder, jobs=jobs, progress=progress, listener=listener)


def _recorded_scenario(folder: Path) -> Scenario:
    """The scenario of a run."""
    record = RunRecord.read(folder)
    source = Path(os.path.normpath(folder / record.scenario_folder))
    if not source.is_dir():
        found = f"the scenario's folder {source} is not there"
        raise InputError(RunFolder(folder).run_record, found, "name the scenario in place of the run")
    return scenario_from_dict(record.scenario, source, str(RunFolder(folder).run_record))
