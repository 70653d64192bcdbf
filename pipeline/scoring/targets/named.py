"""The scores over vehicle-frames that a scenario may ask for, by name: what each vehicle-frame is worth.

A score is the mean of it over the vehicle-frames of a record, see :func:`pipeline.scoring.targets.scores.mean`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from pipeline.scoring.targets.detectability import chances
from pipeline.scoring.targets.record import Floats
from pipeline.scoring.targets.scores import log_points, well
from pipeline.scoring.targets.seen import SeenTargets

Worth = Callable[[SeenTargets], Floats]
"""What a site's sight of each vehicle-frame is worth, (n,)."""


def _found(seen: SeenTargets) -> Floats:
    """The chance that detectors find each; of people, for whom none is calibrated, how well they are seen."""
    return np.where(seen.record.are_people, well(seen.points), chances(seen)) if len(seen) else np.empty(0)


WORTHS: Mapping[str, Worth] = {
    "expected_detections": _found,
    "points_on_target": lambda seen: log_points(seen.points),
    "seen_well": lambda seen: well(seen.points),
}
"""Name -> worth, as ``[score] rank_by`` and ``others`` name them."""
