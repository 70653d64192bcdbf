"""What losses of returns change in the shipped scenarios, for which sensors they act, and what they cost.

``python -m benchmarks.losses [SCENARIO...]`` runs each scenario twice: with the rule that decides on losses
(:func:`egvs.sensors.return_model.decide_losses`), and with ``effects.range_limit = false``. It prints as tables the
sensors of each scenario and the decision; the largest shares found and noticed, the best site and the rank correlation,
without and with losses, and what the scores of some sites cost with losses, in multiples of that without, timed in
turns (kept in ``docs/data/losses_in_scenarios.csv``). Then, for each scenario, which sensors of the catalogue would not
need losses, which needs no run. ``--sensors NAME,NAME`` (or ``all``) repeats the first table for
:data:`SENSOR_SCENARIO` with each sensor at all
sites.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

import egvs
from egvs.artefacts.readers import read_scores
from egvs.artefacts.run_folder import RunFolder
from egvs.runs import run
from egvs.runs.run_context import open_folder
from egvs.scenario.model import Scenario
from egvs.sensors.return_model import LossDecision, decide_losses
from egvs.sensors.sensor import CATALOGUE, scenario_sensor
from egvs.sensors.sites import candidate_sites
from egvs.stages.site_scans import empty_scans
from egvs.stages.site_scoring import SiteScoring

SCENARIOS = Path(__file__).parents[1] / "scenarios"
SENSOR_SCENARIO = "nishishinjuku"
FRAMES = 500
OFF = "effects.range_limit=false"
FOUND, NOTICED = "expected_detections", "noticed"
REPEATS, SITES = 7, 4


def settings_of(name: str) -> list[str]:
    """Return settings that make a run of a scenario short; its own traffic where that is recorded."""
    is_simulated = egvs.load(SCENARIOS / name).traffic.frames is not None
    return [f"traffic.frames={FRAMES}"] if is_simulated else []


def decide(scenario: Scenario, sensor: str | None = None) -> LossDecision:
    """Return the decision of the rule for the sensors of a scenario, or for one sensor at all sites."""
    sites = candidate_sites(scenario)
    if sensor is not None:
        sites = tuple(replace(site, sensor=sensor) for site in sites)
    names = {site.sensor for site in sites}
    sensors = {name: scenario_sensor(name, scenario, "benchmark") for name in names}
    return decide_losses(sites, sensors, scenario.roi.box)


def describe_decision(decision: LossDecision) -> str:
    """Return for which sensors losses act, with the range without losses and the reach of the region."""
    texts = []
    for state, sensors in (("on", decision.acting), ("off", decision.negligible)):
        texts += [f"{name}: {state} ({limit:.0f} of {reach:.0f} m)" for name, (reach, limit) in sensors.items()]
    return ", ".join([*texts, *(f"{name}: off (no rated range)" for name in decision.unrated)])


def losses_ratio(scenario: Path, settings: Sequence[str], folder: Path) -> float:
    """Return the cost of the scores of some sites with losses of returns, in multiples of that without.

    Parameters
    ----------
    scenario, settings
        The scenario, and its settings apart from losses.
    folder
        A finished run of it.
    """
    scorings = []
    for setting in (OFF, "effects.range_limit={}"):
        context = open_folder(egvs.load(scenario, [*settings, setting]), folder, jobs=1)
        scoring = SiteScoring(context)
        scorings.append((scoring, list(empty_scans(context, scoring.names[:SITES]))))
    ratios = []
    for turn in range(REPEATS + 1):
        taken = []
        for scoring, scans in scorings:
            start = time.process_time()
            for scan in scans:
                scoring.score(scan)
            taken.append(time.process_time() - start)
        if turn:  # the first compiles
            ratios.append(taken[1] / taken[0])
    return statistics.median(ratios)


def table_row(name: str, settings: Sequence[str], out: Path, sensor: str | None = None) -> str:
    """Run a scenario without and with losses; return a row of the table."""
    scenario, shares, bests, ranks = SCENARIOS / name, [], [], []
    for extra, folder in (([OFF], out / "off"), ([], out / "rule")):
        run.run(egvs.load(scenario, [*settings, *extra]), folder)
        scores = read_scores(RunFolder(folder).scores).sort_by("site").to_pydict()
        shares.append([max(scores[score]) for score in (FOUND, NOTICED)])
        bests.append(scores["site"][int(np.argmin(scores["rank"]))])
        ranks.append(scores["rank"])
    changes = [f"{100 * before:.1f} to {100 * after:.1f} %" for before, after in zip(*shares, strict=True)]
    best = "the same" if bests[0] == bests[1] else f"{bests[0]} to {bests[1]}"
    rho = float(np.asarray(spearmanr(*ranks).statistic))
    cost = losses_ratio(scenario, settings, out / "rule")
    decision = describe_decision(decide(egvs.load(scenario, settings), sensor))
    return f"| {name} | {decision} | {changes[0]} | {changes[1]} | {best} | {rho:.2f} | {cost:.2f} |"


HEADING = (
    "| scenario | losses by the rule (range without losses, of the region's reach) | largest share found "
    "| largest share noticed | best site | rank correlation | cost |\n|---|---|---|---|---|---|---|"
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run scenarios without and with losses, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = sorted(path.parent.name for path in SCENARIOS.glob("*/scenario.toml"))
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help=f"of {', '.join(names)}; default: all")
    parser.add_argument("--sensors", help=f"sensors at all sites of {SENSOR_SCENARIO}: NAME,NAME or all")
    options = parser.parse_args(arguments)
    scenarios = options.scenarios or names
    if unknown := set(scenarios) - set(names):
        parser.error(f"expected SCENARIO of {', '.join(names)}, got {', '.join(sorted(unknown))}")

    with tempfile.TemporaryDirectory() as temporary:
        print(HEADING)
        for name in scenarios:
            print(table_row(name, settings_of(name), Path(temporary) / name), flush=True)
        if options.sensors:
            print("\n" + HEADING)
            for sensor in CATALOGUE if options.sensors == "all" else options.sensors.split(","):
                settings = [*settings_of(SENSOR_SCENARIO), f'sites.replace_sensor="{sensor}"']
                print(table_row(SENSOR_SCENARIO, settings, Path(temporary) / sensor, sensor), flush=True)

    print("\n| scenario | sensors of the catalogue that need no losses |\n|---|---|")
    for name in scenarios:
        scenario = egvs.load(SCENARIOS / name)
        idle = [sensor for sensor in CATALOGUE if not decide(scenario, sensor).acting]
        print(f"| {name} | {', '.join(idle) or 'none'} |")


if __name__ == "__main__":
    main()
