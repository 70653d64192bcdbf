"""What the ranking rests on, in sentences; the section on ``egvs accuracy``."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import StageRecord
from egvs.core.errors import Diagnostic
from egvs.results.labels import join_names
from egvs.results.ranking import Pole
from egvs.scenario.model import NO_SURROUNDINGS, POLE_POSITIONS, Scenario
from egvs.scenario.signal_config import ASSUMED_PLANS
from egvs.scenario.traffic_config import CountConfig
from egvs.traffic.directions import COMPASS
from egvs.traffic.signal_descriptions import ASSUMED_SOURCE, plan_title

NAMED_POLES = 5
"""Poles at the head of the ranking whose location in a lane is stated with the result."""

_FURTHER_SITES = re.compile(r" and \d+ more$")
"""End of the location of a warning that is the same for several sites."""

_SITES_ON_LANES = "sites on lanes"
"""Rule of the warnings of a check about sites in lanes or junctions."""

_NOT_STARTED = "waiting"
"""Rule of the warning that several per cent of the vehicles could not start."""

_TRAFFIC = re.compile(r"\btraffic\b(?! (?:light|sign))", re.IGNORECASE)
"""Found in entries of the key ``assumed`` on traffic; traffic lights and signs are not traffic."""


# ---- what the ranking rests on


def assumptions(scenario: Scenario, plans: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return what a scenario assumes rather than measures: its key ``assumed``, and traffic without any count.

    Parameters
    ----------
    scenario
        The scenario. Where it has plans of signals, those that are still assumed are named, if there are any. Poles
        that exist are not assumed; that nothing stands beside the road is.
    plans
        Plans of the signals in the region, from the summary of the traffic
        (:func:`egvs.traffic.signal_descriptions.describe_signals`).
    """
    traffic = scenario.traffic
    assumed = scenario.assumed
    if traffic.signals and plans:
        remaining = [plan_title(plan) for plan in plans if plan["source"] == ASSUMED_SOURCE]
        named = (f"{ASSUMED_PLANS} of {join_names(remaining)}",) if remaining else ()
        assumed = tuple(chain.from_iterable(named if entry == ASSUMED_PLANS else (entry,) for entry in assumed))
    if scenario.sites.existing_poles == "all":
        assumed = tuple(entry for entry in assumed if entry != POLE_POSITIONS)
    elif scenario.sites.existing_poles:
        others = f"{POLE_POSITIONS} other than {join_names(scenario.sites.existing_poles)}"
        assumed = tuple(others if entry == POLE_POSITIONS else entry for entry in assumed)
    statics = scenario.statics
    has_surroundings = statics.footprints or statics.polygons or statics.meshes or scenario.sites.points
    if not has_surroundings and NO_SURROUNDINGS not in assumed:
        assumed = (*assumed, NO_SURROUNDINGS)
    has_demand = traffic.network is None or bool(traffic.counts or traffic.routes)
    if has_demand or any(period.counts or period.routes for period in traffic.periods):
        return assumed
    return (*assumed, "traffic (random trips)")


_BY_IMPORTANCE = (
    "traffic",
    "uncounted",
    "building is known",
    "surroundings",
    "positions",
    "signal",
    "heights of .*building",
)
"""Beginnings of what scenarios assume, that which affects a ranking most first; all other entries follow."""


_NAMED_ASSUMPTIONS = 2
_LONG = 75
"""Longer lists of assumptions leave out what is in brackets, except sides of approaches, and name one of several."""


def main_assumptions(assumed: Sequence[str]) -> str:
    """Return the assumptions that affect a ranking most, and how many more there are, in one sentence.

    Empty where nothing is assumed. ``assumed`` is from :func:`assumptions`.
    """

    def order(entry: str) -> int:
        return next((n for n, word in enumerate(_BY_IMPORTANCE) if re.search(word, entry)), len(_BY_IMPORTANCE))

    if not assumed:
        return ""
    entries = sorted(assumed, key=order)
    named = "; ".join(entries[:_NAMED_ASSUMPTIONS])
    if len(named) > _LONG:
        without_lists = [re.sub(r"(: [^,]+), .*", r"\1 and others", entry) for entry in entries[:_NAMED_ASSUMPTIONS]]
        named = re.sub(rf" \((?!{'|'.join(COMPASS)})[^)]*\)", "", "; ".join(without_lists))
    more = f"; {len(entries) - _NAMED_ASSUMPTIONS} more" if len(entries) > _NAMED_ASSUMPTIONS else ""
    return f"Assumed, not measured: {named}{more}."


def describe_missing_traffic(warnings: Iterable[Diagnostic]) -> str:
    """Return that many vehicles could not start, in one sentence; empty if the warnings of a run do not say so."""
    for warning in warnings:
        if warning.rule == _NOT_STARTED:
            return f"Careful: {warning.problem.partition(', because')[0]}, so the traffic is less than the demand."
    return ""


def describe_poles_on_road(poles: Iterable[Pole], warnings: Iterable[Diagnostic]) -> list[str]:
    """Return a phrase for each pole in a lane or junction, e.g. ``"k02 stands in a lane of Main Street"``.

    Parameters
    ----------
    poles
        The poles.
    warnings
        Warnings of a run; those of the rule :data:`_SITES_ON_LANES` name sites.
    """
    where_of_site = {}
    for warning in warnings:
        if warning.rule != _SITES_ON_LANES:
            continue
        _, _, site = warning.where.partition(": site ")
        if site:
            where_of_site[_FURTHER_SITES.sub("", site)] = warning.problem.partition(" is ")[2]
        else:  # a list of all further sites
            for name in warning.problem.partition(": ")[2].split(", "):
                where_of_site[name] = "in a lane or junction"

    phrases = []
    for pole in poles:
        where = next((where_of_site[site.site] for site in pole.sites if site.site in where_of_site), None)
        if where is not None:
            phrases.append(f"{pole.name} stands {where}")
    return phrases


def describe_caveats(
    scenario: Scenario, result: str, poles_on_road: Sequence[str] = (), plans: Sequence[Mapping[str, Any]] = ()
) -> str:
    """Return what to check before one trusts a result, in one sentence; empty where there is nothing.

    Parameters
    ----------
    scenario
        Its assumptions are listed.
    result
        ``"ranking"`` or ``"plan"``.
    poles_on_road
        From :func:`describe_poles_on_road`.
    plans
        Plans of signals, as for :func:`assumptions`.
    """
    caveats = []
    if poles_on_road:
        caveats.append(join_names(poles_on_road))
    assumed = assumptions(scenario, plans)
    if assumed:
        caveats.append(f"assumed, not measured: {'; '.join(assumed)}")
    if not caveats:
        return ""
    return f"Before you trust this {result}: {'; '.join(caveats)}."


def assumes_flows(scenario: Scenario) -> bool:
    """Return whether the key ``assumed`` says that the traffic, hence the flows in ``counts``, is assumed."""
    return any(_TRAFFIC.search(entry) for entry in scenario.assumed)


def busiest_counts(scenario: Scenario) -> tuple[str, tuple[CountConfig, ...]]:
    """Return the period with most vehicles per hour (empty without periods) and its counts."""
    periods = {name: period.traffic.counts for name, period in scenario.by_period().items()}
    name = max(periods, key=lambda period: math.fsum(count.per_hour for count in periods[period]))
    return name, periods[name]


def describe_counts(scenario: Scenario, network: Path | None) -> dict[str, str]:
    """Return the movement of each traffic count in words, by its location in the summary of the traffic.

    Parameters
    ----------
    scenario
        The counts.
    network
        The simulated network; None if the run folder has none.
    """
    periods = {name: period.traffic for name, period in scenario.by_period().items() if period.traffic.counts}
    if network is None or not periods:
        return {}
    from egvs.traffic.movements import MovementNames
    from egvs.traffic.network import read_net_xml

    x_m, y_m, _ = scenario.roi.center_m
    flows = [count for traffic in periods.values() for count in traffic.counts]
    names = MovementNames(read_net_xml(network), (x_m, y_m), flows)
    movements = {}
    for name, traffic in periods.items():
        period = f" ({name})" if name else ""
        for count in traffic.counts:
            movements[f"{count.title}{period}"] = names.describe(count.edge or count.from_edge or "", count.to_edge)
    return movements


# ---- egvs accuracy


def study_values(folder: RunFolder, stages: Mapping[str, StageRecord]) -> dict[str, Any]:
    """Return what the page shows of the accuracy study of a run; ``study`` is None without one."""
    if not folder.accuracy_figure.is_file():
        return {"study": None}

    from egvs.results.studies import AccuracyResults

    study = AccuracyResults.read(folder, stages)
    if study is None:
        return {"study": None}
    tolerance = f"{study.tolerance.loss_points:g} percentage points of vehicles found"
    if study.tolerance.score is not None:
        tolerance = f"{100 * study.tolerance.score:g} % of the score"
    figure = base64.b64encode(folder.accuracy_figure.read_bytes()).decode("ascii")
    return {"study": study, "study_tolerance": tolerance, "study_figure": figure}
