"""What a run keeps of each site alone, written while sites are scored: ``visibility.parquet``, ``blindspots.parquet``.

It is the most that is known of a site; so many sites take no more memory than a few.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.artefacts import tables
from pipeline.artefacts.blindspots import BLINDSPOTS
from pipeline.artefacts.tables import TableWriter
from pipeline.scoring.blindspots import table
from pipeline.scoring.blindspots.table import SpotWriter
from pipeline.stages.base import Workspace
from pipeline.stages.shared.site_scoring import ScoredSite
from pipeline.stages.shared.target_scores import Targets

VISIBILITY = "visibility.parquet"


class SiteDetails:
    """Writes both files. Made by :func:`writing`."""

    def __init__(self, files: ExitStack, visibility: Path, spots: SpotWriter | None) -> None:
        self._files, self._path, self._spots = files, visibility, spots
        self._visibility: TableWriter | None = None

    def take(self, its: ScoredSite) -> ScoredSite:
        """Write what is kept of a site; the site without that."""
        if its.visible is not None:
            if self._visibility is None:
                self._visibility = self._files.enter_context(tables.writer(self._path, "visibility"))
            self._visibility.write({"site": [its.site.name] * len(its.visible["hits"]), **its.visible})
        targets = its.targets
        if self._spots is not None and targets is not None and targets.missed is not None:
            self._spots.add(its.site.name, targets.missed)
            targets = replace(targets, missed=None)
        return replace(its, visible=None, targets=targets)

    def describe(self, about: dict[str, Any]) -> None:
        """Set the metadata of what was written."""
        for file in (self._visibility, self._spots):
            if file is not None:
                file.describe(about)


@contextmanager
def writing(work: Workspace, targets: Targets | None, sites: int) -> Iterator[SiteDetails]:
    """Open the files that are asked for, for so many sites; they appear when the block ends well, and those of before
    go."""
    visibility, blindspots = work.path(VISIBILITY), work.path(BLINDSPOTS)
    with ExitStack() as files:
        spots = None
        if targets is not None and targets.spots is not None:
            mixed = bool(work.scenario.traffic.periods)
            spots = files.enter_context(table.writer(blindspots, targets.spots, sites, mixed=mixed))
        its = SiteDetails(files, visibility, spots)
        yield its
        for path, file in ((visibility, its._visibility), (blindspots, spots)):
            if file is None:
                path.unlink(missing_ok=True)
