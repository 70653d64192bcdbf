"""What a planner sets otherwise while sensors are moved: gamma, the score that ranks, effects.

A setting is a run of its own, as ``egvs run --set`` makes it, so that its numbers are those of such a run. It is made
in a folder that goes with the page; stages that the setting does not touch are taken over from the run that is
explored.
"""

from __future__ import annotations

import math
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.artefacts.readers import PLACEMENT_SUMS
from pipeline.artefacts.run_record import RECORD
from pipeline.core.progress import Progress, silent
from pipeline.effects import registry
from pipeline.explore.session import Session
from pipeline.placement.writing import CURVE, PLACEMENT
from pipeline.runs import stages, workflow
from pipeline.runs.locking import alone
from pipeline.scenario.loading import from_values
from pipeline.scenario.models import Scenario
from pipeline.stages.base import Workspace
from pipeline.studies import effect_overview

NEEDED = ("check", "statics", "scan", "traffic", "tpog", "score")
"""The stages that a session reads."""

_OFFERED = ("on", "skipped", "called for")


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

    def over(self, scenario: Scenario, place: str = "") -> Scenario:
        """The scenario with these settings; InputError, naming ``place`` or its file, where one of them is wrong."""
        if self == Settings.of(scenario):
            return scenario
        values = scenario.model_dump(mode="json")
        if self.gamma is not None:
            values["score"]["gamma"] = "inf" if math.isinf(self.gamma) else self.gamma
        values["score"]["rank_by"] = self.rank_by
        named = values["effects"]
        values["effects"] = {name: named[name] if name in named else trial_of(name) for name in sorted(self.effects)}
        return from_values(values, scenario.folder, place or str(scenario.file))

    def in_words(self, scenario: Scenario) -> tuple[str, ...]:
        """What ``egvs run --set`` takes for them, one a setting that is another than the scenario's."""
        own, said = Settings.of(scenario), []
        if self.gamma is not None:
            said.append(f"score.gamma={self.gamma:g}")
        if self.rank_by != own.rank_by:
            said.append(f"score.rank_by={self.rank_by}")
        more, less = sorted(self.effects - own.effects), sorted(own.effects - self.effects)
        said += [f"effects.{name}={{{', '.join(f'{k}={v}' for k, v in trial_of(name).items())}}}" for name in more]
        return (*said, *(f"without effects.{name}" for name in less))


def trial_of(effect: str) -> dict[str, Any]:
    """The parameters of an effect that the scenario does not name: those that it is tried with."""
    return dict(registry.effect_class(effect).TRIAL)


def offered(session: Session) -> dict[str, str]:
    """The effects that a scenario names or that its scene calls for, and why."""
    calls = effect_overview.called_in(session.scene)
    found = {call.name: call.why for call in calls if call.state in _OFFERED}
    named = session.scenario.effects.named
    return {name: why for name, why in found.items() if name in named or not registry.effect_class(name).UNTOLD}


def session_in(
    scenario: Scenario, folder: Path, *, jobs: int | None = None, progress: Progress = silent, **more: Any
) -> Session:
    """A session over a scenario in a run's folder; what is not up to date there is made first."""
    record = workflow.run(scenario, folder, only=NEEDED, jobs=jobs, progress=progress, **more)
    with alone(folder):
        work = Workspace(scenario, folder, jobs=jobs, recorded=stages.recorded(record))
        return Session(work, {name: stage.inputs for name, stage in record.stages.items()})


class Variants:
    """The run that is explored, and what it would be with other settings.

    Parameters
    ----------
    session
        As it was opened; it is the one without other settings.
    scratch
        A folder that goes with the page.
    """

    def __init__(self, session: Session, scratch: Path) -> None:
        self._own, self._folder = session, scratch / "run"

    @property
    def scenario(self) -> Scenario:
        """As it was opened."""
        return self._own.scenario

    def session(self, settings: Settings, progress: Progress = silent) -> Session:
        """The session with some settings.

        Raises
        ------
        InputError
            Where a run with them would be refused.
        """
        scenario = settings.over(self.scenario)
        if scenario is self.scenario:
            return self._own
        if not (self._folder / RECORD).is_file():
            _take_over(self._own.work.folder, self._folder)
        return session_in(scenario, self._folder, jobs=self._own.work.threads, progress=progress)


def _take_over(run: Path, folder: Path) -> None:
    """Copy what stages and ``egvs place`` wrote; the record comes last, so that it is never of files that are not
    there."""
    folder.mkdir(parents=True, exist_ok=True)
    made = [name for stage in NEEDED for name in stages.written_by(stage)]
    with alone(run):
        for path in (run / name for name in (*made, PLACEMENT, CURVE, PLACEMENT_SUMS, RECORD)):
            if path.is_dir():
                shutil.copytree(path, folder / path.name, dirs_exist_ok=True)
            elif path.is_file():
                shutil.copyfile(path, folder / path.name)
