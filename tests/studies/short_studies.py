"""Short studies, and helpers for tests of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import egvs
from egvs.core.progress import no_progress
from egvs.studies import accuracy, study_settings
from egvs.studies.accuracy import AccuracyStudy, StudyOptions
from egvs.studies.measurement import SettingRunner
from egvs.studies.recommendation import SettingResult, Tolerance
from egvs.studies.study_settings import Setting, SettingValues

ROOT = Path(__file__).resolve().parents[2]
MEASURED = {"seconds", "statics_s", "scan_s", "traffic_s", "tpog_s", "score_s", "front", "recommended"}
"""Columns that depend on measured times."""

FEW_VALUES = SettingValues(
    traffic_parts=(0.5,),
    traffic_factors=(2, 4),
    steps_s=(0.5,),
    frame_periods_s=(1.0,),
    voxels_m=(1.0,),
    gammas=(2.0,),
    detectors=False,
    unnamed_effects=False,
    traffic_options=False,
)


def run_study(
    path: Path,
    sets: list[str],
    out: Path,
    *,
    budget_s: float = 600.0,
    listener: Any = None,
    tolerance: Tolerance = Tolerance(1.0),  # noqa: B008  (frozen)
    **options: Any,
) -> AccuracyStudy:
    """Run a study of a few settings."""
    values = {"values": FEW_VALUES, **options}
    return accuracy.run_accuracy_study(
        path, sets, out, StudyOptions(tolerance, budget_s, **values), listener=listener or accuracy.ignore_setting
    )


def make_runner(path: Path, out: Path, *sets: str) -> SettingRunner:
    return SettingRunner(path, sets, out, 1, no_progress)


def settings_by_name(path: Path, *sets: str) -> dict[str, Setting]:
    return {setting.name: setting for setting in study_settings.list_variants(egvs.load(path, sets))}


def count_progress(calls: list[str]) -> Callable[[str, int, int], None]:
    """Return a progress callback that notes its calls."""
    return lambda what, _done, _total: calls.append(what)


def shares(path: Path, sets: list[str], out: Path) -> np.ndarray:
    """Return scores as shares of their limit, from an ordinary run."""
    egvs.run(egvs.load(path, sets), out)
    table = egvs.read_scores(out / "scores.parquet")
    return table["egvs"].to_numpy() / table["egvs_limit"].to_numpy()


def compared(study: AccuracyStudy) -> list[tuple[object, ...]]:
    names = [f for f in SettingResult.__dataclass_fields__ if f not in MEASURED]
    return sorted(tuple(str(getattr(row, name)) for name in names) for row in study.rows)
