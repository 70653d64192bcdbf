"""What the program says of a scenario, and its scores: the stages in this process, in their order."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pyarrow.parquet as pq

import egvs
from egvs.core.errors import WARNINGS_KEY, Diagnostic, DiagnosticsError, InputError, RunError
from egvs.stages import check, scan, score, statics, tpog, traffic
from tests.stage_runner import run_stage

STAGES: tuple[ModuleType, ...] = (traffic, statics, tpog, scan, score)


def outcome(folder: Path) -> tuple[dict[str, float], list[Diagnostic]]:
    """Scores of the sites, empty where an error stops the run; all errors and warnings."""
    try:
        scenario = egvs.load(folder)
        findings = list(check.check_scenario(scenario).findings)
        if any(finding.is_error for finding in findings):
            return {}, findings
        for stage in STAGES:
            summary = run_stage(stage, scenario, folder / "out", jobs=1)
            findings += [Diagnostic(**warning) for warning in summary.get(WARNINGS_KEY, ())]
    except DiagnosticsError as error:
        return {}, [*error.findings, *error.warnings]
    except InputError as error:
        return {}, [Diagnostic.of("input", error)]
    except RunError as error:
        return {}, [Diagnostic("run", str(error), str(error), "", is_error=True)]
    rows = pq.read_table(folder / "out" / "scores.parquet", columns=["site", "egvs"]).to_pylist()
    return {row["site"]: row["egvs"] for row in rows}, findings
