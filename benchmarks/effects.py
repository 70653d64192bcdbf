"""Cost of effects, compared with a scene without them.

Hits of some sites of the shipped junction, from scans that are cast beforehand, on one thread. Each effect is timed in
turns with the plain scene; medians of the ratios are printed. Losses of returns are also timed with all scores of a
site, over voxels and vehicles, as a run computes them.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import egvs
from benchmarks.losses import OFF, losses_ratio
from egvs.artefacts.tpog import Tpog, read_tpog
from egvs.scoring.visibility import Beams, HitCounter
from egvs.sensors.scanner import Scanner
from egvs.stages import scene_inputs
from egvs.world.mesh import World, read_ply

ROOT = Path(__file__).resolve().parent.parent
SCENARIO = ROOT / "scenarios" / "nishishinjuku"
REPEATS = 7
SITES = 4

COSTS: dict[str, tuple[list[str], float | None]] = {
    "dropout": (["effects.dropout.share=0.1"], 1.2),
    "rain": (["effects.rain.rate_mm_h=20"], 1.2),
    "fog": (["effects.fog.visibility_m=200"], 1.2),
    "range_limit": (["effects.range_limit={}"], 1.2),
    "range_limit, hard": (["effects.range_limit={softness = 0, reflectivity = 0.1}"], 1.2),
    "foliage": (["effects.foliage.leaf_area_density=1"], None),
    "moving_occlusion, 500 frames": (["effects.moving_occlusion.frames=500"], 4.0),
    "divergence, 7 sub-beams": (["effects.divergence.sub_beams=7"], 5.0),
}
"""Settings, and the largest allowed ratio to the plain scene.

The last two are above it. What did not help: marking the frames of a box for all beams of a bundle at once; the
fixed-point traversal for shares that fall along a beam, as finding where costs what it saves; one slab around the
sub-beams of a beam, as few voxels are crossed by all of them.
"""

MAX_LOSSES_RATIO = 1.3
"""Largest allowed ratio of all scores of a site with losses of returns to those without."""


@dataclass(frozen=True)
class Work:
    """Scans of some sites, and what counts their hits."""

    visibility: HitCounter
    beams: list[Beams]
    cells: NDArray[np.int64]

    @classmethod
    def of(cls, settings: list[str], world: World, tpog: Tpog, run: Path) -> Work:
        """Prepare the static world, TPOG and trajectories of a finished run."""
        is_named = any(setting.startswith("effects.range_limit") for setting in settings)
        scene = scene_inputs.resolve_scene(egvs.load(SCENARIO, settings if is_named else [OFF, *settings]), world)
        scanner = Scanner(scene)
        beams = [Beams.of(scanner.scan_site(site)) for site in scene.sites[:SITES]]
        return cls(HitCounter(scene, tpog, run / "trajectories.parquet"), beams, np.flatnonzero(tpog.counts))

    def seconds(self) -> float:
        """Return the processor seconds to count the hits once."""
        start = time.process_time()
        for beams in self.beams:
            self.visibility.borrowed_hits(beams, self.cells)
        return time.process_time() - start


def rows(run: Path) -> list[tuple[str, str, str, bool]]:
    """Return name, ratio, limit and whether it holds for each effect."""
    world, tpog = read_ply(run / "statics.ply")[0], read_tpog(run / "tpog.parquet")
    plain = Work.of([], world, tpog, run)
    named = {name: Work.of(settings, world, tpog, run) for name, (settings, _) in COSTS.items()}
    ratios: dict[str, list[float]] = {name: [] for name in named}
    for turn in range(REPEATS + 1):
        march = plain.seconds()
        for name, work in named.items():
            took = work.seconds()
            if turn:  # the first compiles
                ratios[name].append(took / march)
    table = []
    for name, (_, most) in COSTS.items():
        ratio = statistics.median(ratios[name])
        bound = "" if most is None else f"{most:g} x"
        table.append((f"  {name}, compared with no effect", f"{ratio:.2f} x", bound, most is None or ratio <= most))
    ratio = losses_ratio(SCENARIO, [], run)
    name = "  losses of returns in all scores of a site, compared with none"
    table.append((name, f"{ratio:.2f} x", f"{MAX_LOSSES_RATIO:g} x", ratio <= MAX_LOSSES_RATIO))
    return table
