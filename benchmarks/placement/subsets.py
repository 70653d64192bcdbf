"""Plans of nishishinjuku's 13 sites against every subset, and the time that many candidates take.

    python -m benchmarks.placement.subsets [SCENARIO]

For 1 to 4 sensors: the exact plan is the best of all subsets, to the last bit. Then, of SCENARIO, a plan of five
sensors once its traffic is simulated: what is proved, seconds, memory.
"""

from __future__ import annotations

import itertools
import resource
import sys
import tempfile
from pathlib import Path
from time import perf_counter

import pipeline
from pipeline.artefacts.run_record import RunRecord
from pipeline.placement import asking, placing
from pipeline.placement.joint_score import NEEDED
from pipeline.placement.solving import planning
from pipeline.runs import stages, workflow
from pipeline.stages.base import Workspace

SCENARIOS = Path(__file__).parent.parent.parent / "scenarios"


def main() -> None:
    """Print both."""
    with tempfile.TemporaryDirectory() as folder:
        _subsets(Path(folder) / "nishishinjuku")
        if len(sys.argv) > 1:
            _many(Path(sys.argv[1]), Path(folder) / "many")


def _subsets(out: Path) -> None:
    scenario = pipeline.load(SCENARIOS / "nishishinjuku", ["placement.count=4"])
    record: RunRecord = workflow.run(scenario, out)
    asked = asking.ask(Workspace(scenario, out, recorded=stages.recorded(record)), lambda _: None)
    for count in (1, 2, 3, 4):
        problem = asked.problem.with_count(count)
        found = planning.best(problem, search_all=True, time_limit_s=600.0, heard=lambda _: None)
        every = itertools.combinations(range(len(asked.sites)), count)
        best = max(problem.worth(plan).value for plan in every)
        names = ", ".join(asked.names[i] for i in found.order)
        same = "the best of all subsets to the last bit" if found.point.worth.value == best else "NOT THE BEST"
        print(f"{count}: {names}: {found.point.worth.value!r}, {same}; {found.nodes} nodes")
    best_site = record.stages["score"].summary["best"]
    print(f"egvs run: best {', '.join(best_site)}")


def _many(path: Path, out: Path) -> None:
    scenario = pipeline.load(path, ["placement.count=5", "scan.keep=false"])
    workflow.run(scenario, out, only=NEEDED)
    started = perf_counter()
    placed = placing.place(scenario, out)
    seconds = perf_counter() - started
    memory_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    picks = ", ".join(pick.site.name for pick in placed.picks)
    print(f"{placed.candidates} candidates, {len(placed.picks)} sensors: {picks}")
    print(f"proved: {placed.certificate:.2%} of the best; {seconds:.1f} s, {memory_gb:.2f} GB at most")


if __name__ == "__main__":
    main()
