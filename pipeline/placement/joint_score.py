"""The joint score of several LiDARs, for notebooks and searches of one's own."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pipeline.core.errors import InputError
from pipeline.core.progress import Progress, silent
from pipeline.placement import asking
from pipeline.placement.asking import Asked
from pipeline.runs import stages, workflow
from pipeline.scenario.models import Scenario
from pipeline.scoring.visibility import Beams
from pipeline.sensing.scanner import Scan
from pipeline.stages.base import Workspace

NEEDED = ("check", "statics", "scan", "traffic", "tpog")
"""The stages that candidates are looked from after."""


class JointScore:
    """What a set of candidates is worth together, by the score that ``score.rank_by`` names.

    A gain takes about 2.5 ns for each cell that the candidate hits: well below a millisecond at 0.5 m voxels.

    ::

        joint = pipeline.JointScore.of(scenario, "runs/trial")
        joint.add("c03")
        joint.gain("c10")
    """

    def __init__(self, asked: Asked) -> None:
        self._asked = asked
        self._seen = asked.problem.together()
        self._place = {name: i for i, name in enumerate(asked.names)}

    @classmethod
    def of(
        cls, scenario: Scenario, out: str | Path | None = None, *, jobs: int | None = None, progress: Progress = silent
    ) -> JointScore:
        """Of a scenario's candidates; brings what it needs up to date in the run's folder."""
        folder = Path(out) if out is not None else workflow.default_folder(scenario)
        record = workflow.run(scenario, folder, only=NEEDED, jobs=jobs, progress=progress)
        work = Workspace(scenario, folder, jobs=jobs, progress=progress, recorded=stages.recorded(record))
        return cls(asking.ask(work, lambda done: progress("candidates", done, 0)))

    @property
    def candidates(self) -> tuple[str, ...]:
        """Their names, in the order of the sites."""
        return tuple(self._place)

    @property
    def chosen(self) -> tuple[str, ...]:
        """Those in the set, in the order in which they came."""
        return tuple(self._asked.names[i] for i in self._seen.chosen)

    @property
    def value(self) -> float:
        """The joint score of the set; the same for any order."""
        return self._seen.value(self._asked.problem.joint)

    @property
    def together(self) -> float:
        """That of all candidates."""
        return self._asked.together

    def add(self, *names: str) -> None:
        """Put candidates into the set."""
        for i in self._indices(names):
            if i not in self._seen.chosen:
                self._seen.add(i)

    def remove(self, *names: str) -> None:
        """Take candidates out of the set."""
        for i in self._indices(names):
            if i in self._seen.chosen:
                self._seen.remove(i)

    def gain(self, pose: str | Scan) -> float:
        """What a candidate, or the empty scan of any pose (:meth:`pipeline.Scanner.scan`), would add to the set; 0 for
        a candidate that is in it."""
        if isinstance(pose, Scan):
            return self._seen.value_with(self._asked.problem.joint, self._asked.row(Beams.of(pose))) - self.value
        (i,) = self._indices([pose])
        if i in self._seen.chosen:
            return 0.0
        return float(self._seen.gains(self._asked.problem.joint, np.array([i], dtype=np.int64))[0])

    def gains(self) -> dict[str, float]:
        """What each candidate would add."""
        every = np.arange(len(self._place), dtype=np.int64)
        gained = self._seen.gains(self._asked.problem.joint, every)
        gained[self._seen.chosen] = 0.0
        return dict(zip(self.candidates, gained.tolist(), strict=True))

    def _indices(self, names: Iterable[str]) -> list[int]:
        for name in names:
            if name not in self._place:
                raise InputError(
                    f"candidate {name!r}", "no such candidate", f"one of {', '.join(self.candidates[:20])}"
                )
        return [self._place[name] for name in names]
