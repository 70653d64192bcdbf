"""Writes ``fused.parquet``: what detectors find with 1, 2, ... sensors of a plan."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artefacts import tables
from pipeline.validation import detection
from pipeline.validation.fused.gains import FusedDetection

ARTEFACT = "fused.parquet"


def write(path: Path, rows: Sequence[FusedDetection], metadata: Mapping[str, Any]) -> None:
    """Write all rows."""
    columns: dict[str, Any] = {
        "sensors": np.array([len(row.sites) for row in rows], dtype=np.uint32),
        "sites": [json.dumps(list(row.sites), ensure_ascii=False) for row in rows],
        **detection.columns_of([row.detection for row in rows]),
        "gain": [row.gain.value for row in rows],
        "gain_se": [row.gain.se for row in rows],
    }
    tables.write(path, "fused", columns, dict(metadata))
