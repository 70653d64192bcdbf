"""One car of one size in the middle of all new points."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from egvs.clouds.sweeps import Detections, SiteView, Sweep
from egvs.core.grid import Roi
from egvs.extensions.validation.detectors import background


class Middle:
    NAME: ClassVar[str] = "middle"
    SOURCE: ClassVar[str] = "an example"
    settings: ClassVar[dict[str, Any]] = {"size_m": [4.5, 1.8, 1.5]}

    def at_site(self, view: SiteView, roi: Roi) -> "MiddleAtSite":
        return MiddleAtSite(view)


@dataclass(frozen=True)
class MiddleAtSite:
    view: SiteView

    def detect(self, sweep: Sweep) -> Detections:
        points_m = background.points_in_world(sweep, self.view)[background.foreground_mask(sweep, self.view)]
        if not len(points_m):
            return Detections.empty()
        box = [*points_m.mean(axis=0), *Middle.settings["size_m"], 0.0]
        return Detections(np.array([box]), np.array([len(points_m)], dtype=np.float64))
