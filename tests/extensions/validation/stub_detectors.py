"""Detectors for tests, in a module that other processes can import."""

import os
import signal
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egvs.clouds.sweeps import Detections
from egvs.core.errors import InputError


@dataclass(frozen=True)
class MiddleDetector:
    """Detects one box at the mean of the foreground points; its score is their number."""

    NAME = "middle"
    SOURCE = "tests"
    size_m: float = 4.0

    @property
    def settings(self):
        return {"size_m": self.size_m}

    def at_site(self, view, roi):
        del roi
        return _MiddleAtSite(view, self.size_m)


@dataclass(frozen=True)
class _MiddleAtSite:
    view: object
    size_m: float

    def detect(self, sweep):
        at = sweep.points[:, :3].astype(np.float64)
        far = np.sqrt((at**2).sum(axis=1))
        new = far < self.view.empty_range_m[sweep.beam] - 0.5
        if not new.any():
            return Detections.empty()
        centre = at[new].mean(axis=0) + np.asarray(self.view.pose.position_m)  # sensors of the tests are not tilted
        return Detections(np.array([[*centre, self.size_m, 2.0, 1.5, 0.0]]), np.array([float(new.sum())]))


@dataclass(frozen=True)
class FailingDetector(MiddleDetector):
    """Fails at a site if there is a file with its name, which contains the kind of failure."""

    NAME = "odd"
    folder: Path = Path()

    def at_site(self, view, roi):
        if (self.folder / view.site).exists():
            what = (self.folder / view.site).read_text()
            if what == "refuse":
                raise InputError("model.onnx", "no model", "Use a model")
            if what == "die":
                os._exit(3)
            if what == "interrupt":
                os.kill(os.getppid(), signal.SIGINT)
                threading.Event().wait()
            if what == "orphan":
                with (self.folder / "alive").open("wb") as alive:
                    alive.write(b"x")
                    alive.flush()
                    os.kill(os.getppid(), signal.SIGKILL)
                    threading.Event().wait()
        return super().at_site(view, roi)
