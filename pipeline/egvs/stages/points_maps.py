"""Maps of the points on target of a run: from its sites, and from the sensors of its plan together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from egvs.core.grid import Grid
from egvs.effects.returns import ReturnProbability
from egvs.scoring.points_map import TARGETS, PointsMap, TargetPositions
from egvs.scoring.visibility import Beams
from egvs.stages.base import StageContext


def target_positions(context: StageContext, grid: Grid) -> tuple[TargetPositions, ...]:
    """Return where the standard targets stand; nothing where the traffic does not come from one road network.

    Parameters
    ----------
    context
        Its scenario names the network.
    grid
        Its region of interest is mapped.
    """
    network = context.inputs.common_network
    if network is None:
        return ()
    return tuple(TargetPositions.of(target, network, grid) for target in TARGETS)


def points_maps(
    context: StageContext, positions: Iterable[TargetPositions], scans: Iterable[tuple[str, Beams]]
) -> Iterator[tuple[str, PointsMap]]:
    """Yield the map of each target from each of some named scans, with the name."""
    positions = tuple(positions)
    for name, beams in scans:
        probability = ReturnProbability.of(context.scene, beams.sensor)
        for positions_of_target in positions:
            yield name, positions_of_target.points_map(beams, probability)
