"""The file of models, ``pipeline/egvs/scoring/target_scores.json``: trees, training data, and cross-validation.

Each tree and each part of the calibration curve has its own line, so that changes are easy to see.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from egvs.scoring.target_scores import FEATURES

MADE_BY = "python -m benchmarks.across_junctions fit"
FINDS = "a box that overlaps the vehicle by more than 0.7, in the mean of seen from above and in space"


@dataclass(frozen=True)
class TrainingJunction:
    """A training junction.

    Attributes
    ----------
    sites
        From how many each detector looked.
    sensors
        Of the sites.
    vehicle_frames
        Of the traffic, the same for all sites.
    """

    sites: Mapping[str, int]
    sensors: tuple[str, ...]
    vehicle_frames: int


@dataclass(frozen=True)
class TrainingMetadata:
    """What the models were trained with.

    Attributes
    ----------
    learnt_on
        By the junction's name.
    frames
        Of each junction's traffic.
    settings
        Hash of each detector's settings, or of its model.
    scikit_learn
        The version that fitted.
    """

    learnt_on: Mapping[str, TrainingJunction]
    frames: int
    settings: Mapping[str, str]
    scikit_learn: str

    def to_json(self) -> dict[str, Any]:
        """Return the metadata as in the file."""
        return {"made_by": MADE_BY, "finds": FINDS, "features": list(FEATURES), **asdict(self)}


def text(metadata: TrainingMetadata, models: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the complete file.

    Parameters
    ----------
    models
        By detector: ``base`` and ``trees`` of :func:`benchmarks.across_junctions.models.fitting.fit_model`, and
        ``elsewhere`` of :func:`benchmarks.across_junctions.models.fitting.cross_validate`.
    """
    head = json.dumps(metadata.to_json(), indent=1).replace("\n", "\n ")
    each = ",\n".join(f'  "{name}": {_model(model)}' for name, model in models.items())
    return f'{{\n "about": {head},\n "detectors": {{\n{each}\n }}\n}}\n'


def _model(model: Mapping[str, Any]) -> str:
    rho, curve = model["elsewhere"]["rho_with_ap"], model["elsewhere"]["calibration"]
    parts = ",\n     ".join(json.dumps(part) for part in curve)
    trees = ",\n    ".join(json.dumps(tree, separators=(",", ":")) for tree in model["trees"])
    elsewhere = f'{{\n    "rho_with_ap": {json.dumps(rho)},\n    "calibration": [\n     {parts}\n    ]\n   }}'
    return f'{{\n   "elsewhere": {elsewhere},\n   "base": {model["base"]},\n   "trees": [\n    {trees}\n   ]\n  }}'
