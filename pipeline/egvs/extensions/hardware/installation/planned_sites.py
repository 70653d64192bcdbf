"""The sites of a finished run at which sensors are installed: those of its plan, and every candidate by its name."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from egvs.artefacts.run_folder import RunFolder
from egvs.core.errors import InputError, unknown_site
from egvs.explore.session import Session
from egvs.export.finished_run import FinishedRun
from egvs.results.map_credits import read_map_credits
from egvs.results.plans import SensorPlan
from egvs.sensors import site_feasibility
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Pose, Site


@dataclass(frozen=True, eq=False)
class PlannedSites:
    """The sites of a finished run.

    Attributes
    ----------
    run
        The run.
    """

    run: FinishedRun

    @classmethod
    def open(cls, folder: Path) -> PlannedSites:
        """Open a run folder; InputError if it has no finished run."""
        return cls(FinishedRun.open(folder))

    @cached_property
    def session(self) -> Session:
        """Scores of any pose in the run."""
        return Session(self.run.work, {name: stage.inputs for name, stage in self.run.record.stages.items()})

    @cached_property
    def plan(self) -> dict[str, Pose]:
        """Poses of the sensors of the plan in the run folder, in its order; empty without a plan.

        Raises
        ------
        InputError
            If the plan is for other traffic, sites or settings than the run.
        """
        folder = self.run.work.folder
        plan = SensorPlan.read(folder)
        if plan is None:
            return {}
        if not plan.belongs_to(self.run.record.stages):
            problem = "the plan is for other traffic, sites or settings than the run"
            raise InputError(folder.placement, problem, "Run egvs place again, or remove the file.")
        return {sensor.site: sensor.mount.pose for sensor in plan.sensors}

    def resolve(self, name: str) -> str:
        """Return the site that is meant by the name of a site or a pole: of a pole that of the plan, or its best.

        Raises
        ------
        InputError
            If there is neither such a site nor such a pole, or the plan has several sensors on the pole.
        """
        candidates = self.session.candidates
        if name in candidates:
            return name
        on_pole = [candidate.site.name for candidate in self.session.ranked if candidate.site.pole == name]
        planned = [site for site in self.plan if site in on_pole]
        if len(planned) > 1:
            problem = f"the plan has {len(planned)} sensors on pole {name!r}"
            raise InputError("--site", problem, f"Choose one of {', '.join(planned)}.")
        if on_pole:
            return (planned or on_pole)[0]
        poles = dict.fromkeys(candidate.site.pole for candidate in candidates.values())
        raise unknown_site("--site", name, list(poles), "this run has", noun="pole or site")

    def site(self, name: str) -> Site:
        """Return a candidate by its name, at its pose in the plan if it is part of the plan.

        Parameters
        ----------
        name
            Name of the site.

        Raises
        ------
        InputError
            If there is no such site, with the names of those that exist.
        """
        candidates = self.session.candidates
        if name not in candidates:
            raise unknown_site("--site", name, list(candidates), "this run has")
        site = candidates[name].site
        return replace(site, pose=self.plan.get(name, site.pose))

    @cached_property
    def map_credits(self) -> tuple[str, ...]:
        """Who made the maps of the scenario, each as "Map data (c) OpenStreetMap contributors"."""
        return tuple(f"Map data {credit}" for credit in read_map_credits(self.run.scenario))

    def sensor(self, site: Site) -> Sensor:
        """Return the sensor of a site."""
        return self.session.scene.sensor(site.sensor, f"site {site.name}")

    def ground_m(self, site: Site) -> float:
        """Return the height of the ground below a site, world frame."""
        return site_feasibility.ground_height_m(self.session.scene.world, site.pose)

    @property
    def default_sites(self) -> tuple[str, ...]:
        """The sites of the plan, or the best site without a plan."""
        return tuple(self.plan) or (self.session.ranked[0].site.name,)


def path_in_run(path: Path, folder: RunFolder) -> str:
    """Return the path of a file relative to its run folder, with slashes; empty if it is elsewhere."""
    try:
        return path.resolve().relative_to(folder.path.resolve()).as_posix()
    except ValueError:
        return ""
