"""Compare the plans of several city runs: how much does a plan depend on the assumed traffic demand?

Each run has its own traffic, and a plan for the same request. Two questions are answered. Which share of the sensors
of a plan do the other plans have too? And what is a plan worth in the traffic of the other runs? The second is the
more important one: two plans without a common sensor may be equally good.

Only the planned sites are scanned again, so this is much faster than making a plan.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import NamedTuple

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.run_record import RunRecord
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.progress import ProgressCallback, no_progress
from egvs.extensions.city import results
from egvs.extensions.city.results import CityPlan, junction_run_folder, mean_vehicles, score_factor
from egvs.placement import problem_builder
from egvs.placement.problem import CoverageState
from egvs.results.plans import PlannedSensor
from egvs.runs.run_context import open_folder
from egvs.scenario.loading import scenario_from_dict
from egvs.stages.base import StageContext

_TOLERANCE = 1e-9
"""Relative difference of scores that are equal but for rounding."""


class CommonShares(NamedTuple):
    """Shares of the sensors of a plan that another plan has too, or all other plans: 0 to 1.

    ``sensors``: at the same site, with the same height and orientation; ``poles``: at the same pole; ``junctions``: at
    the same junction. A pole or a junction with two sensors in one plan and one in the other has one in common.
    """

    sensors: float
    poles: float
    junctions: float


@dataclass(frozen=True)
class PlanComparison:
    """The plans of several city runs.

    Attributes
    ----------
    folders, plans
        The folders of the runs, and their plans, r of them.
    values
        Joint score of plan i (row) in the traffic of run j (column), (r, r) float64.
    """

    folders: tuple[Path, ...]
    plans: tuple[CityPlan, ...]
    values: FloatArray

    def common(self, i: int, others: Sequence[int]) -> CommonShares:
        """Return the shares of the sensors of plan i that all of some other plans have too."""
        plans = [self.plans[i], *(self.plans[j] for j in others)]
        return CommonShares(
            _common_share(plans, lambda sensor: (sensor.junction, sensor.site)),
            _common_share(plans, lambda sensor: (sensor.junction, sensor.pole)),
            _common_share(plans, lambda sensor: (sensor.junction,)),
        )

    def common_to_all(self, i: int) -> CommonShares:
        """Return the shares of the sensors of plan i that all plans have."""
        return self.common(i, [j for j in range(len(self.plans)) if j != i])

    @property
    def relative_values(self) -> FloatArray:
        """Value of plan i in the traffic of run j, relative to the plan of that run, (r, r); NaN where that is 0."""
        best = np.diag(self.values)
        return np.divide(self.values, best, out=np.full_like(self.values, np.nan), where=best > 0.0)


def _common_share(plans: Sequence[CityPlan], key: Callable[[PlannedSensor], tuple[str, ...]]) -> float:
    counts = [Counter(key(sensor) for sensor in plan.sensors) for plan in plans]
    if not counts[0]:
        return 1.0
    return reduce(lambda a, b: a & b, counts).total() / counts[0].total()


def compare_plans(folders: Sequence[Path], progress: ProgressCallback = no_progress) -> PlanComparison:
    """Compare the plans in the folders of two or more city runs.

    Parameters
    ----------
    folders
        Folders in which ``egvs city place`` has written a plan, each with its own traffic.
    progress
        Called with the number of junctions whose plans have been scored.

    Raises
    ------
    InputError
        When a folder has no plan, the plans are for different requests or scores, the junctions or their sites differ,
        or files of the city have changed since a plan was made.
    """
    if len(folders) < 2 or len({folder.resolve() for folder in folders}) < len(folders):
        problem = f"expected two or more different folders, got {', '.join(map(str, folders))}"
        raise InputError("RUN", problem, "Give one folder for each traffic demand.")
    junctions = _check_equal_junctions(folders)
    plans = tuple(_read_plan(folder, junctions) for folder in folders)
    for folder, plan in zip(folders, plans, strict=True):
        if (plan.rank_by, plan.requested) != (plans[0].rank_by, plans[0].requested):
            problem = f"expected a plan for {_describe(plans[0])}, as in {folders[0]}, got {_describe(plan)}"
            raise InputError(folder / results.PLAN_TABLE, problem, "Repeat egvs city place with the same request.")

    used = [name for name in junctions if any(name in plan.by_junction for plan in plans)]
    values = np.zeros((len(plans), len(plans)))
    for j, folder in enumerate(folders):
        for number, name in enumerate(used, start=1):
            sites = [[sensor.site for sensor in plan.sensors if sensor.junction == name] for plan in plans]
            values[:, j] += _joint_scores(junction_run_folder(folder, name), sites)
            progress(f"plans in the traffic of {folder.name}", number, len(used))
        _check_unchanged(folder, plans[j], float(values[j, j]))
    return PlanComparison(tuple(folders), plans, values)


def _check_equal_junctions(folders: Sequence[Path]) -> list[str]:
    """Return the names of the junctions, which all runs have; raise an InputError if they differ."""
    junctions: list[list[str]] = []
    for folder in folders:
        path = folder / results.JUNCTIONS_TABLE
        if not path.is_file():
            raise InputError(folder, "this is no folder of a city run", "Give a folder written by egvs city place.")
        junctions.append(sorted(parquet.read_artefact(path, "city")[0].column("junction").to_pylist()))
        if junctions[-1] != junctions[0]:
            different = ", ".join(sorted(set(junctions[-1]) ^ set(junctions[0])))
            problem = f"expected the same junctions as in {folders[0]}; the difference is {different}"
            raise InputError(path, problem, "Compare runs of the same junctions.")
    return junctions[0]


def _read_plan(folder: Path, junctions: Sequence[str]) -> CityPlan:
    plan = results.read_plan(folder, junctions)
    if plan is None:
        problem = "there is no plan for the junctions and settings of this run"
        raise InputError(folder / results.PLAN_TABLE, problem, "Run egvs city place with --out for this folder.")
    return plan


def _check_unchanged(folder: Path, plan: CityPlan, value: float) -> None:
    """Raise an InputError if a plan no longer has its score: sites or solids have changed since it was made."""
    if abs(value - plan.joint) > _TOLERANCE * plan.joint:
        problem = f"the plan now scores {value:g} instead of {plan.joint:g}: files of the city have changed"
        raise InputError(folder, problem, "Run egvs city place again with --out for this folder.")


def _describe(plan: CityPlan) -> str:
    request = " and ".join(f"{key} {value:g}" for key, value in plan.requested.items())
    return f"{request} by {plan.rank_by}"


def _joint_scores(run: Path, plans: Sequence[Sequence[str]]) -> FloatArray:
    """Return the joint score of each plan of a junction, in the traffic of a finished run, as the city counts it."""
    context = _open_run(run)
    names = {site.name for site in context.scene.sites}
    for site in sorted(set().union(*plans) - names):
        hint = "Compare runs with the same candidates at every junction."
        raise InputError(run, f"there is no site {site}, which is in the plan of another run", hint)
    factor = score_factor(context.scenario.score.rank_by, mean_vehicles(run))
    used = [site.name for site in context.scene.sites if site.name in set().union(*plans)]
    if not used:
        return np.zeros(len(plans))
    objective = problem_builder.make_objective(context, problem_builder.read_tpogs(context))
    (visibility,) = problem_builder.visibility_matrices(context, (objective.view,), lambda _: None, only=used)
    term = objective.terms(visibility)[""]
    return factor * np.array([CoverageState([term], map(used.index, plan)).value(term) for plan in plans])


def _open_run(folder: Path) -> StageContext:
    """Open the folder of a junction's run with the settings that it was made with."""
    record = RunRecord.read(folder)
    source = Path(os.path.normpath(folder / record.scenario_folder))
    scenario = scenario_from_dict(record.scenario, source, str(folder))
    return open_folder(scenario, folder, jobs=1)
