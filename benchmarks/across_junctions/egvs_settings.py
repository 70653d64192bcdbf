"""EGVS with each choice of its parameters, as the records name it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from egvs.core import files
from egvs.extensions.validation.results import ScoreName

GAMMAS = (1.0, 2.0, 5.0, 10.0, 20.0, math.inf)
VOXELS_M = (0.25, 0.5, 1.0)


@dataclass(frozen=True)
class Setting:
    """EGVS with one choice of its parameters."""

    gamma: float
    voxel_m: float
    occlusion: bool

    def __str__(self) -> str:
        """Return the score's name in a record."""
        parameters = {
            "gamma": "inf" if self.gamma == math.inf else self.gamma,
            "moving_occlusion": self.occlusion,
            "voxel_m": self.voxel_m,
        }
        return str(ScoreName("egvs", files.canonical_json(parameters).decode()))


DEFAULT = Setting(10.0, 0.25, False)
"""The default of a scenario when the study was made."""

SETTINGS = tuple(
    Setting(gamma, voxel_m, moving) for voxel_m in VOXELS_M for moving in (False, True) for gamma in GAMMAS
)
"""Every setting that is measured."""
