"""The empty scans of the sensors of a plan."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.sensors.sites import Site
from egvs.stages.base import StageContext
from egvs.stages.site_scans import empty_scans


def plan_beams(context: StageContext, sensors: Sequence[Site], *, moved: bool) -> Iterator[tuple[str, Beams]]:
    """Yield the name and the empty scan of each sensor of a plan, in any order.

    Parameters
    ----------
    context
        The run, with the scans of its candidates.
    sensors
        The plan; names are those of candidates.
    moved
        Whether the sensors were moved from their candidates, so that they are scanned anew.
    """
    if not moved:
        for scan in empty_scans(context, {sensor.name for sensor in sensors}):
            yield scan.site.name, scan.beams
        return
    scanner = Scanner(context.scene)
    for sensor in sensors:
        yield sensor.name, Beams.of(scanner.scan_site(sensor))
