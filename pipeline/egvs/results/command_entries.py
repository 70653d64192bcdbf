"""Results of commands that still belong to a run: what-ifs, installation sheets, acceptance checks, sensor design.

An entry of a file of results (:mod:`egvs.artefacts.command_results`) belongs to a run while the stages that it depends
on have the same inputs, and its digest of further settings (:data:`DIGEST_KEY`) is the present one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from egvs.artefacts.command_results import read_results
from egvs.artefacts.run_folder import COMMAND_RESULTS, RunFolder
from egvs.artefacts.run_record import StageRecord
from egvs.core import files
from egvs.core.digests import hash_input
from egvs.core.errors import InputError
from egvs.scenario.model import Scenario

DIGEST_KEY = "digest"
"""Key of an entry with a hash of settings that no stage depends on."""

Entries = Mapping[str, Mapping[str, Any]]
"""Values of the entries of a file, by name."""


def what_if_digest(scenario: Scenario, tables: Iterable[str]) -> str | None:
    """Return a hash of some tables ``[what_if.NAME]`` and their files; None where one does not exist."""
    values = []
    for name in tables:
        if name not in scenario.what_if:
            return None
        table = scenario.what_if[name]
        named = [*table.footprints, *([table.vehicles] if table.vehicles else [])]
        try:
            digests = [hash_input(scenario.find(file, f"what_if.{name}")) for file in named]
        except InputError:  # a file was removed since
            return None
        values.append([name, table.model_dump(mode="json"), digests])
    return files.hash_json(values)


def design_digest(scenario: Scenario) -> str:
    """Return a hash of the settings of sensors, scores and effects, on which the design of a sensor depends."""
    sensors = {name: sensor.model_dump(mode="json") for name, sensor in scenario.sensors.items()}
    parts = [sensors, scenario.score.model_dump(mode="json"), scenario.effects.model_dump(mode="json")]
    return files.hash_json(parts)


def current_entries(folder: RunFolder, scenario: Scenario, stages: Mapping[str, StageRecord]) -> dict[str, Entries]:
    """Return the entries that belong to a run, by file and name; files without one are left out.

    Parameters
    ----------
    folder, scenario
        The run.
    stages
        Its recorded stages.
    """
    current: dict[str, Entries] = {}
    for file in COMMAND_RESULTS:
        entries = {}
        for name, result in read_results(folder.path / file.name).items():
            if not result.is_current(stages):
                continue
            digest = None
            if file is RunFolder.what_if:
                digest = what_if_digest(scenario, result.values["tables"])
            elif file is RunFolder.sensor_design:
                digest = design_digest(scenario)
            if digest == result.values.get(DIGEST_KEY):
                entries[name] = result.values
        if entries:
            current[file.name] = entries
    return current
