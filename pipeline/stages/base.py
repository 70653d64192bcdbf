"""What does every stage promise?

A stage is a module = a verb of the command line = an artefact. It has

- ``NAME`` and ``ARTEFACTS``: the verb, and the files that it may write into the run's folder;
- ``inputs(scenario, out)``: a JSON value with everything that the stage reads (settings by value, files by sha256). Two
  runs with equal inputs write equal bytes, so a stage whose inputs did not change is skipped;
- ``run(scenario, out, ...)``: reads files, writes files, returns a small JSON value that says what came out.

A stage imports no other stage.
"""

from __future__ import annotations

from typing import Any

from pipeline.artefacts import schemas
from pipeline.core import files
from pipeline.scenario.models import Scenario


def metadata(scenario: Scenario, inputs: dict[str, Any], **more: Any) -> dict[str, Any]:
    """The metadata that every artefact carries.

    ``scenario.hash`` covers the settings that this artefact depends on, ``inputs`` also the files: a setting that the
    stage does not read changes no byte. So those in which nothing is random pass ``seed=None``."""
    return {
        "schema": schemas.VERSION,
        "scenario": {"name": scenario.name, "hash": files.hash_of(inputs.get("settings", {}))},
        "inputs": files.hash_of(inputs),
        "seed": scenario.seed,
        **more,
    }
