"""Compare plans of nishishinjuku's 13 sites with every subset, and measure a plan of many candidates.

    python -m benchmarks.placement.subsets [SCENARIO]

For 1 to 4 sensors, the exact plan must be the best of all subsets, to the last bit. Then, for SCENARIO, a plan of five
sensors: what is proved, seconds, and memory.
"""

from __future__ import annotations

import itertools
import resource
import sys
import tempfile
from pathlib import Path
from time import perf_counter

import egvs
from egvs.artefacts.run_record import RunRecord
from egvs.placement import plan, problem_builder, solver
from egvs.placement.plan import REQUIRED_STAGES
from egvs.runs import run, stage_registry
from egvs.runs.run_context import open_folder

SCENARIOS = Path(__file__).parent.parent.parent / "scenarios"


def main() -> None:
    """Print both."""
    with tempfile.TemporaryDirectory() as folder:
        _subsets(Path(folder) / "nishishinjuku")
        if len(sys.argv) > 1:
            _many(Path(sys.argv[1]), Path(folder) / "many")


def _subsets(out: Path) -> None:
    scenario = egvs.load(SCENARIOS / "nishishinjuku", ["placement.count=4", "score.rank_by='egvs'"])
    record: RunRecord = run.run(scenario, out)
    built = problem_builder.build_problem(
        open_folder(scenario, out, recorded=stage_registry.recorded_digests(record)), lambda _: None
    )
    for count in (1, 2, 3, 4):
        problem = built.problem.with_count(count)
        solution = solver.best_plan(problem, search_all=True, time_limit_s=600.0, on_progress=lambda _: None)
        every = itertools.combinations(range(len(built.sites)), count)
        best = max(problem.plan_value(plan).value for plan in every)
        names = ", ".join(built.names[i] for i in solution.order)
        same = "the best of all subsets to the last bit" if solution.point.plan_value.value == best else "NOT THE BEST"
        print(f"{count}: {names}: {solution.point.plan_value.value!r}, {same}; {solution.nodes} nodes")
    best_site = record.stages["score"].summary["best"]
    print(f"egvs run: best {', '.join(best_site)}")


def _many(path: Path, out: Path) -> None:
    scenario = egvs.load(path, ["placement.count=5", "scan.keep=false"])
    run.run(scenario, out, only=REQUIRED_STAGES)
    started = perf_counter()
    placed = plan.place(scenario, out)
    seconds = perf_counter() - started
    memory_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    picks = ", ".join(sensor.site for sensor in placed.sensors)
    print(f"{placed.candidates} candidates, {len(placed.sensors)} sensors: {picks}")
    print(f"proved: {placed.certificate:.2%} of the best; {seconds:.1f} s, {memory_gb:.2f} GB at most")


if __name__ == "__main__":
    main()
