"""Tries effects that a scenario does not name: by how much each would change the scores of some sites.

Steps: take the traffic that the scenario's last run has recorded and counted, where it is still the scenario's; scan
and score a few sites, spread over the list, with the scenario's own effects; then again with one more effect. Nothing
is written, and no traffic is simulated, so effects on traffic cannot be tried.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from pipeline.artefacts import tables
from pipeline.artefacts.readers import Tpog, read_tpog
from pipeline.artefacts.run_record import RECORD, RunRecord
from pipeline.core.errors import InputError
from pipeline.effects import scene_resolving
from pipeline.effects.base import Effect, Traffic
from pipeline.runs import stage_keys, stages
from pipeline.scenario.effects import EffectParameters
from pipeline.scoring.scorer import Scorer
from pipeline.sensing.scanner import Scanner
from pipeline.sensing.scene import Scene
from pipeline.stages.base import Workspace
from pipeline.traffic.boxes import Size

SITES = 6
"""Sites that are scored at most."""

_TRAJECTORIES, _TPOG = "trajectories.parquet", "tpog.parquet"


@dataclass(frozen=True)
class Trial:
    """What one effect does to the scores of a few sites.

    Attributes
    ----------
    least, most
        Relative changes of the scores, the one that is nearest to 0 and the one farthest from it.
    sites, of_sites
        How many were scored, of how many there are.
    same_order
        Whether they rank as before.
    """

    least: float
    most: float
    sites: int
    of_sites: int
    same_order: bool


class Trials:
    """Tries one effect after another before a scene, on the traffic of the run in a folder; see :meth:`of`."""

    def __init__(self, scene: Scene, folder: Path) -> None:
        self._scene, self._folder = scene, folder
        every = len(scene.sites)
        picked = np.unique(np.linspace(0, every - 1, min(SITES, every)).round().astype(int))
        self._sites = tuple(scene.sites[i] for i in picked)

    @classmethod
    def of(cls, scene: Scene, folder: Path) -> Trials | None:
        """None where the folder holds no traffic of this scenario as it is now."""
        if not (folder / RECORD).is_file():
            return None
        record = RunRecord.read(folder)
        work = Workspace(scene.scenario, folder, recorded=stages.recorded(record))
        try:
            current = all(
                name in record.stages and record.stages[name].inputs == stage_keys.inputs(name, work).key
                for name in ("traffic", "statics", "tpog")
            )
            work.digests(_TRAJECTORIES, _TPOG)
        except InputError:  # an artefact is gone, or another one
            return None
        return cls(scene, folder) if current else None

    def trial(self, effect: Effect[EffectParameters]) -> Trial | None:
        """What the effect changes; None where that takes other traffic, or every score is 0."""
        if isinstance(effect, Traffic) or not self._plain.any():
            return None
        own = self._scene.scenario.effects
        named = own.model_validate({**own.named, effect.NAME: effect.parameters})
        changed = self._scores(scene_resolving.resolve(self._scene.scenario.with_effects(named), self._scene.world))
        seen = self._plain > 0
        changes = changed[seen] / self._plain[seen] - 1
        least, most = (float(changes[pick(np.abs(changes))]) for pick in (np.argmin, np.argmax))
        order = np.array_equal(np.argsort(-changed, kind="stable"), np.argsort(-self._plain, kind="stable"))
        return Trial(least, most, len(self._sites), len(self._scene.sites), bool(order))

    @cached_property
    def sizes(self) -> dict[str, tuple[Size, float]]:
        """Sizes of the recorded vehicles by a name of their own, each with its share of all boxes."""
        table = tables.read(self._folder / _TRAJECTORIES, "trajectories", ["kind", "length_m"])[0]
        counted = table.group_by(["kind", "length_m"]).aggregate([("length_m", "count")]).to_pylist()
        rows = max(len(table), 1)
        return {
            f"{row['kind']} of {row['length_m']:g} m": (
                Size(row["length_m"], 1.0, 1.0, row["kind"]),
                row["length_m_count"] / rows,
            )
            for row in counted
        }

    @cached_property
    def _tpog(self) -> Tpog:
        return read_tpog(self._folder / _TPOG)

    @cached_property
    def _plain(self) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        return self._scores(self._scene)

    def _scores(self, scene: Scene) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        scanner, scorer = Scanner(scene), Scorer(scene, self._tpog, self._folder / _TRAJECTORIES)
        return np.array([scorer.score(scanner.scan_site(site)).egvs for site in self._sites])
