"""What a sensor is worth where somebody has moved it: the numbers of ``egvs score``, from any pose.

Steps for a pose: ask the rules of ``egvs check`` that are about one site; cast the empty scan from there; score it
against the TPOG, and against the vehicles of recorded frames where the scenario asks for that; rank it among the
candidates, as if the moved one hung there in place of its own. Nothing here knows of a page or a browser.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.blindspots import SiteBlindspots
from pipeline.artefacts.period_ranking import PERIOD_SCORES
from pipeline.artefacts.readers import Tpog, read_periods, read_scores, read_scores_by_period, read_tpog
from pipeline.checks import sites as rules
from pipeline.checks.subject import Subject
from pipeline.core.errors import InputError
from pipeline.core.findings import Finding
from pipeline.effects import scene_resolving
from pipeline.explore import missed
from pipeline.explore.plan import MovingPlan
from pipeline.scenario.models import Scenario
from pipeline.scoring.egvs import EntropyField
from pipeline.scoring.scorer import PeriodTpog, Scorer
from pipeline.scoring.targets.named import WORTHS
from pipeline.scoring.targets.seen import noticed_in, see
from pipeline.scoring.visibility import Beams
from pipeline.sensing.scanner import Scanner
from pipeline.sensing.scene import Scene
from pipeline.sensing.sites import Pose, Site
from pipeline.stages.base import Workspace
from pipeline.stages.shared.scene import scene_of
from pipeline.stages.shared.target_scores import TPOG, TRAJECTORIES, Targets
from pipeline.traffic import sumo_folder
from pipeline.traffic.network import Network
from pipeline.world.carriageway import Carriageway

SCORES = "scores.parquet"
_RECORDED = (TRAJECTORIES, TPOG)


@dataclass(frozen=True)
class Rating:
    """What a sensor is worth in a pose.

    Attributes
    ----------
    site
        The candidate that it comes from.
    scores
        By name: ``egvs`` in bits, ``entropy_seen`` as a share, and what else the scenario asks for; empty where no
        sensor can stand.
    rank
        Among the candidates, 1 is best; 0 where no sensor can stand.
    findings
        What the check says of the place; one of them is an error where no sensor can stand.
    """

    site: Site
    scores: Mapping[str, float]
    rank: int
    findings: tuple[Finding, ...] = ()

    @property
    def stands(self) -> bool:
        """Whether a sensor can stand there."""
        return bool(self.scores)


@dataclass(frozen=True)
class _Engine:
    """What scans and scores with certain effects."""

    scene: Scene
    scanner: Scanner
    scorer: Scorer


class Session:
    """A run that is being explored. It changes nothing in the run's folder.

    Parameters
    ----------
    work
        A folder in which all stages up to ``score`` are done.
    stages
        Their keys, by name: a plan in the folder is taken only where it was made from them.
    period
        Of the traffic, whose scores are told; the mix of all when empty.
    """

    def __init__(self, work: Workspace, stages: Mapping[str, str], period: str = "") -> None:
        self.work, self._stages, self.period = work, stages, period
        self.scenario: Scenario = work.scenario
        self.scene: Scene = scene_of(work)
        self.periods: tuple[str, ...] = tuple(its.name for its in read_periods(work.path(TPOG)) if its.name)
        self.tpog: Tpog = read_tpog(work.path(TPOG), period or None)
        self.candidates: dict[str, Rating] = self._rated()
        self._engines: dict[tuple[str, ...], _Engine] = {}

    def in_period(self, period: str) -> Session:
        """The same run, seen in another period alone; in the mix of all for an empty name."""
        return Session(self.work, self._stages, period)

    def forget(self) -> None:
        """Let go of what scores poses quickly; it is made again when it is asked for."""
        self._engines.clear()
        self.__dict__.pop("entropy_bit", None)

    @cached_property
    def plan(self) -> MovingPlan | None:
        """The plan in the run's folder, where there is one that was made from the same traffic and scans."""
        return MovingPlan.of(self.work, self._stages)

    @property
    def rank_by(self) -> str:
        """The score that ranks."""
        return str(self.scenario.score.rank_by)

    @property
    def ranked(self) -> list[Rating]:
        """The candidates, the best first."""
        return sorted(self.candidates.values(), key=lambda rating: rating.rank)

    @property
    def network(self) -> Network | None:
        """The roads, where the scenario has some."""
        return self.work.remember("explored roads", (), lambda: sumo_folder.roads(self.scenario))

    @property
    def carriageway(self) -> Carriageway | None:
        """The lanes that vehicles drive on, where the scenario has some."""

        def found() -> Carriageway | None:
            its = None if self.network is None else Carriageway.of(self.network)
            return its if its is not None and its.lanes else None

        return self.work.remember("explored lanes", (), found)

    def rate(self, name: str, pose: Pose, sensor: str | None = None) -> Rating:
        """What a candidate's sensor, or another one, is worth in a pose; KeyError where there is no such candidate.

        InputError where there is no such sensor.
        """
        own = self.candidates[name].site
        site = replace(own, pose=pose, sensor=sensor or own.sensor)
        self.scene.sensor(site.sensor)
        if site.points is not None and site != own:
            finding = Finding("measured scan", f"site {name}", "its empty scan was measured",
                              "its own pose: what would be measured elsewhere is not known", is_error=True)  # fmt: skip
            return Rating(site, {}, 0, (finding,))
        findings = self._findings(site)
        if any(finding.is_error for finding in findings):
            return Rating(site, {}, 0, findings)
        try:
            scores = self._scores(site)
        except InputError as error:  # an effect that has to know of the sensor what nobody has said
            return Rating(site, {}, 0, (*findings, Finding.of("score", error)))
        return Rating(site, scores, self._rank(name, scores[self.rank_by]), findings)

    def hits(self, site: Site) -> NDArray[np.float64]:
        """The beams of a sensor that cross each voxel, (nx, ny, nz) float64; InputError where it cannot stand."""
        engine = self._engine(site)
        return engine.scorer.hits(engine.scanner.scan_site(site))

    def beams(self, site: Site) -> Beams:
        """The empty scan of a sensor as scores take it; InputError as above."""
        return Beams.of(self._engine(site).scanner.scan_site(site))

    def returns_m(self, site: Site) -> NDArray[np.float64]:
        """Where the empty scan of a sensor met something, (n, 3) float64, world frame; InputError as above."""
        rows = self._engine(site).scanner.scan_site(site).rows
        return rows.ends_m[rows.returned] + site.pose.position_m

    def beams_m(self, site: Site, ring: int) -> NDArray[np.float64]:
        """The beams of one ring that can meet the region, (n, 2, 3) float64: from the sensor to where each ends, world
        frame. None of a sensor without rings; the last ring for a higher number. InputError as above."""
        scan = self._engine(site).scanner.scan_site(site)
        channels = scan.sensor.channels
        has_rings = channels > 0 and site.points is None
        of_ring = scan.rows.beam % channels == min(ring, channels - 1) if has_rings else slice(0)
        ends = scan.rows.ends_m[of_ring] + site.pose.position_m
        return np.stack([np.broadcast_to(site.pose.position_m, ends.shape), ends], axis=1)

    def blindspots(self, site: Site) -> SiteBlindspots:
        """Where a sensor misses vehicles, of all periods together; InputError as above."""
        asking = _asking_blindspots(self.work, True)
        targets = self.work.remember("targets at places", _RECORDED, lambda: Targets(asking, self.tpog.grid))
        beams = self.beams(site)
        seen = see(targets.record, beams, noticed_in(self.scene_before(site), beams.sensor))
        assert targets.spots is not None
        return missed.of_site(site.name, targets.spots, targets.spots.by(seen.points), self.tpog.grid)

    def scene_before(self, site: Site) -> Scene:
        """The scene with the effects that act while a sensor is as it is now."""
        return self._engine(site).scene

    @cached_property
    def entropy_bit(self) -> NDArray[np.float64]:
        """Entropy of each voxel, (nx, ny, nz) float64."""
        field = EntropyField.of(self.tpog.counts, self.tpog.frames, self.tpog.grid)
        found = np.zeros(self.tpog.counts.size)
        found[field.cells] = field.per_cell_bit
        return found.reshape(self.tpog.grid.shape)

    def _rated(self) -> dict[str, Rating]:
        """The candidates as ``scores.parquet`` has them, or ``scores_by_period.parquet``."""
        path = self.work.path(PERIOD_SCORES if self.period else SCORES)
        self.work.digest(path.name)
        every = (read_scores_by_period if self.period else read_scores)(path).to_pylist()
        rows = {row["site"]: row for row in every if row.get("period", "") == self.period}
        if rows.keys() != {site.name for site in self.scene.sites}:
            raise InputError(path, "holds other sites than the scenario", "egvs run makes it again")
        names = dict.fromkeys(("egvs", "entropy_seen", *self.scenario.score.asked))
        return {
            site.name: Rating(site, {name: rows[site.name][name] for name in names}, rows[site.name]["rank"])
            for site in self.scene.sites
        }

    @cached_property
    def _targets(self) -> Targets | None:
        """The vehicles that scores look at; None where no score does."""
        if not any(name in WORTHS for name in self.scenario.score.asked):
            return None
        lean = _asking_blindspots(self.work, False)
        return self.work.remember("targets", _RECORDED, lambda: Targets(lean, self.tpog.grid))

    def _findings(self, site: Site) -> tuple[Finding, ...]:
        """What the check says of a place, candidates of a rule included: nobody has sorted this one out."""
        asked = self.scenario.sites.model_copy(update={"only_free": False})
        scenario = self.scenario.model_copy(update={"sites": asked})
        subject = Subject(scenario, self.network, self.carriageway, self.scene.world, (site,), self.scene)
        return (*rules.poses(subject), *rules.on_lanes(subject))

    def _engine(self, site: Site) -> _Engine:
        """What scans and scores while a site is as it is now: an effect that changes nothing for the candidates as they
        are given may do so then, and the other way round."""
        sites = tuple(site if its.name == site.name else its for its in self.scene.sites)
        scene = scene_resolving.with_effects(replace(self.scene, sites=sites, effects=(), idle=()))
        key = tuple(effect.NAME for effect in scene.effects)
        if key not in self._engines:
            scene = replace(scene, sites=())  # one caster serves every pose
            self._engines[key] = _Engine(scene, Scanner(scene, mounts=1), self._scorer(scene))
        return self._engines[key]

    def _scorer(self, scene: Scene) -> Scorer:
        """Effects on what is seen know the mix, in a period too."""
        tpog, trajectories = self.work.path(TPOG), self.work.path(TRAJECTORIES)
        mix = read_tpog(tpog) if self.period else self.tpog
        alone = (PeriodTpog(self.period, self.tpog),) if self.period else ()
        return Scorer(scene, mix, trajectories, periods=alone)

    def _scores(self, site: Site) -> dict[str, float]:
        engine = self._engine(site)
        beams = Beams.of(engine.scanner.scan_site(site))
        found = engine.scorer.score(beams)
        found = found.by_period[0] if self.period else found
        scores = {"egvs": found.egvs, "entropy_seen": found.entropy_seen}
        scores |= {name: float(value[0]) for name, value in found.shares.items()}
        if self._targets is not None:
            seen = see(self._targets.record, beams, noticed_in(engine.scene, beams.sensor))
            worth = self._targets.scores(seen)
            whole = {name: float(value[0]) for name, value in worth.scores.items()}
            scores |= worth.by_period[self.periods.index(self.period)] if self.period else whole
        return scores

    def _rank(self, name: str, score: float) -> int:
        others = (its.scores[self.rank_by] for other, its in self.candidates.items() if other != name)
        return 1 + sum(other > score for other in others)


def _asking_blindspots(work: Workspace, asked: bool) -> Workspace:
    """The same folder where blind spots are asked for, or not: they cost time for every pose, and change no score."""
    score = work.scenario.score.model_copy(update={"blindspots": asked})
    other = copy(work)
    other.scenario = work.scenario.model_copy(update={"score": score})
    return other
