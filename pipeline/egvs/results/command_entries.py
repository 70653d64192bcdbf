"""Results of commands that still belong to a run.

An entry of a file of results (:mod:`egvs.artefacts.command_results`) belongs to a run while the stages that it depends
on have the same inputs, and its digest of further settings (:data:`DIGEST_KEY`) is the present one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from egvs.artefacts.command_results import read_results
from egvs.artefacts.run_record import StageRecord, have_inputs
from egvs.core import files
from egvs.core.digests import hash_input
from egvs.core.errors import InputError
from egvs.scenario.model import Scenario

DIGEST_KEY = "digest"
"""Key of an entry with a hash of settings that no stage depends on."""

Entries = Mapping[str, Mapping[str, Any]]
"""Values of the entries of a file, by name."""


def no_digest(values: Mapping[str, Any]) -> None:
    """Stand for the digest of entries that depend on stages only."""


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


def current_entries(
    path: Path, stages: Mapping[str, StageRecord], digest: Callable[[Mapping[str, Any]], str | None] = no_digest
) -> Entries:
    """Return the entries of a file of results that belong to a run; empty without any.

    Parameters
    ----------
    path
        The file.
    stages
        Recorded stages of the run.
    digest
        Returns the present digest of the settings that the values of an entry depend on.
    """
    entries = {}
    for name, result in read_results(path).items():
        if have_inputs(stages, result.stages) and digest(result.values) == result.values.get(DIGEST_KEY):
            entries[name] = result.values
    return entries
