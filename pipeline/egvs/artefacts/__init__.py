"""The files of a run folder: names, schemas, reading and writing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from egvs.core.lazy import lazy_exports

if TYPE_CHECKING:
    from egvs.artefacts.readers import read_blindspots, read_placement, read_scans, read_scores, read_visibility
    from egvs.artefacts.run_folder import RunFolder
    from egvs.artefacts.tpog import Tpog, read_tpog
    from egvs.artefacts.traffic_frames import read_trajectories

__all__ = [
    "RunFolder",
    "Tpog",
    "read_blindspots",
    "read_placement",
    "read_scans",
    "read_scores",
    "read_tpog",
    "read_trajectories",
    "read_visibility",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "readers": ["read_blindspots", "read_placement", "read_scans", "read_scores", "read_visibility"],
        "run_folder": ["RunFolder"],
        "tpog": ["Tpog", "read_tpog"],
        "traffic_frames": ["read_trajectories"],
    },
)
