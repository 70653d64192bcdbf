"""Where a command takes its settings from: a scenario with overrides, or the folder of a run, whose settings it uses.

A run folder is one with a ``run.json`` and without a ``scenario.toml``. Its settings are fixed, so there are no further
overrides, and results are written into it.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord, suggest_runs
from egvs.core.errors import InputError
from egvs.runs import stage_keys
from egvs.runs.run import default_folder
from egvs.runs.run_context import open_folder
from egvs.scenario.loading import apply_overrides, load, scenario_from_dict
from egvs.scenario.model import SCENARIO_FILE, Scenario
from egvs.scenario.settings import changed_settings

PLAN_REQUEST = ("placement.count", "placement.budget", "placement.reach")
"""Settings that ``egvs place`` replaces by its options: a run keeps its folder when another plan is requested."""

_INPUT_STAGES = ("check", "statics", "traffic")
"""Stages that read the files of a scenario, and no artefacts."""

_TEXT_KEYS = ("name", "description", "assumed", "extends")
"""Settings that no score depends on."""


def recorded_scenario(folder: Path) -> Scenario:
    """Return the scenario that a run was made with, from its ``run.json``.

    Parameters
    ----------
    folder
        The run folder.

    Raises
    ------
    InputError
        When there is no valid record, or the scenario's folder does not exist.
    """
    return _rebuild(folder, RunRecord.read(folder))


def _rebuild(folder: Path, record: RunRecord, overrides: Sequence[str] = ()) -> Scenario:
    record_file = RunFolder(folder).run_record
    source = Path(os.path.normpath(folder / record.scenario_folder))
    if not source.is_dir():
        problem = f"the scenario's folder {source} does not exist"
        raise InputError(record_file, problem, "Give the scenario instead of the run.")
    scenario = scenario_from_dict(apply_overrides(record.scenario, overrides), source, str(record_file))
    scenario._overrides = record.overrides
    return scenario


@dataclass(frozen=True)
class SettingsSource:
    """A scenario with overrides, or a run folder.

    Attributes
    ----------
    path
        The scenario's folder or file, or the run folder.
    overrides
        Arguments of ``--set``; none for a run folder.
    """

    path: Path
    overrides: tuple[str, ...] = ()

    @classmethod
    def of(cls, path: Path, overrides: Sequence[str] | None = None, out: Path | None = None) -> SettingsSource:
        """Return the source of the settings of a command.

        Parameters
        ----------
        path, overrides, out
            Arguments of the command: scenario or run, ``--set`` and ``--out``.

        Raises
        ------
        InputError
            When a run folder is given together with one of the other two, or the path does not exist, but runs of its
            name do.
        """
        if not path.exists() and (hint := suggest_runs(path)):
            raise InputError(path, "no such folder", hint)
        source = cls(path, tuple(overrides or ()))
        for option, is_given in (("--set", bool(overrides)), ("--out", out is not None)):
            if is_given and source.is_run:
                raise InputError(option, f"cannot be used with a run folder ({path})", "Give the scenario instead.")
        return source

    @property
    def is_run(self) -> bool:
        """Whether the settings are those of a run."""
        return RunFolder(self.path).has_record and not (self.path / SCENARIO_FILE).exists()

    def load(self, more: Sequence[str] = ()) -> Scenario:
        """Return the scenario.

        Parameters
        ----------
        more
            Further overrides, by which the folder of the run does not change.

        Raises
        ------
        InputError
            When the scenario, or the record of the run, is not valid.
        """
        if self.is_run:
            return _rebuild(self.path, RunRecord.read(self.path), more)
        scenario = load(self.path, (*self.overrides, *more))
        if more:
            scenario._overrides = load(self.path, self.overrides).overrides
        return scenario

    def load_variant(self, more: Sequence[str]) -> Scenario:
        """Return the scenario with further overrides, as that of another run, which has a folder of its own.

        Parameters
        ----------
        more
            Further overrides.

        Raises
        ------
        InputError
            When the scenario, the record of the run, or an override is not valid.
        """
        if not self.is_run:
            return load(self.path, (*self.overrides, *more))
        base = _rebuild(self.path, RunRecord.read(self.path))
        scenario = _rebuild(self.path, RunRecord.read(self.path), more)
        changed = changed_settings(base.model_dump(mode="json"), scenario.model_dump(mode="json"))
        scenario._overrides = {**base.overrides, **changed}
        return scenario

    def load_with_request(self, request: Sequence[str]) -> Scenario:
        """Return the scenario with a request for a plan in place of the one that the run recorded, if there is one.

        Parameters
        ----------
        request
            Overrides of :data:`PLAN_REQUEST`.
        """
        if not self.is_run or not request:
            return self.load(request)
        record = RunRecord.read(self.path)
        for key in PLAN_REQUEST:
            record.scenario["placement"].pop(key.rpartition(".")[2], None)
        return _rebuild(self.path, record, request)

    def folder(self, scenario: Scenario, out: Path | None = None) -> Path:
        """Return the folder where results of a command are written.

        Parameters
        ----------
        scenario
            From :meth:`load`.
        out
            ``--out`` of the command.
        """
        if self.is_run:
            return self.path
        return out or default_folder(scenario)


def changed_files(folder: Path, scenario: Scenario) -> list[str]:
    """Return the names of the input files that have changed since a run, or that are missing now, sorted.

    Parameters
    ----------
    folder
        The run folder.
    scenario
        From :func:`recorded_scenario`.
    """
    stages = RunRecord.read(folder).stages
    context = open_folder(scenario, folder)
    changed: set[str] = set()
    for name in _INPUT_STAGES:
        if name not in stages:
            continue
        try:
            present = stage_keys.stage_key(name, context).dependencies.files
        except InputError:  # of a file that the check names
            continue
        before = stages[name].files
        changed |= {_file_name(file) for file in before if present.get(file) != before[file]}
    return sorted(changed)


def _file_name(name: str) -> str:
    """Return the file of a name in a record, e.g. of "sites.file = sites.csv"."""
    return name.rpartition(" = ")[2]


def edited_settings(scenario: Scenario) -> list[str]:
    """Return the settings of a run, apart from its overrides, that the scenario file has changed since, by full key.

    Parameters
    ----------
    scenario
        From :func:`recorded_scenario`.
    """
    try:
        present = load(scenario.folder)
    except InputError:  # such as a file that is not complete without overrides
        return []
    return [key for key in compared_settings(present, scenario) if key not in scenario.overrides]


def compared_settings(base: Scenario, scenario: Scenario) -> dict[str, Any]:
    """Return the settings of a scenario that differ from those of another, by full key.

    Texts, and the request for a plan, are left out: no score depends on them.

    Parameters
    ----------
    base, scenario
        Two scenarios, e.g. that of a run and the present one.
    """
    changed = changed_settings(base.model_dump(mode="json"), scenario.model_dump(mode="json"))
    return {key: value for key, value in changed.items() if key not in (*_TEXT_KEYS, *PLAN_REQUEST)}
