"""What may be laid over the scene: traffic, what a sensor sees and misses of it, its empty scan, beams of one ring."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from pipeline.core.grid import Vec3
from pipeline.explore import shapes
from pipeline.explore.session import Rating, Session

NOTHING, TRAFFIC, SEEN, MISSED, SCAN, RING = LAYERS = (
    "none", "traffic (TPOG)", "entropy seen", "entropy missed", "empty scan", "beams of a ring"
)  # fmt: skip

NAME = "/layer"
"""Of what is laid over it, in the scene."""

_SCAN, _RETURN_M, _BEAM_M = (200, 30, 80), 0.12, 0.04


def draw(scene: viser.SceneApi, session: Session, rating: Rating, layer: str, ring: int, zero_m: Vec3) -> None:
    """Lay one of :data:`LAYERS` over a scene, of a sensor as it is now, in place of what was there; nothing where it
    cannot stand.

    Parameters
    ----------
    ring
        Whose beams are drawn; the last one for a higher number.
    """
    if layer == RING and rating.stands:
        lines = (session.beams_m(rating.site, ring) - zero_m).astype(np.float32)
        if len(lines):
            scene.add_line_segments(NAME, lines, _SCAN, thickness=_BEAM_M)
            return
    points, colours = _points(session, rating, layer, zero_m)
    if not len(points):
        scene.remove_by_name(NAME)
        return
    size_m = _RETURN_M if layer == SCAN else session.tpog.grid.voxel_m
    scene.add_point_cloud(NAME, points, colours, point_size=size_m, precision="float32", point_shading="flat")


def _points(
    session: Session, rating: Rating, layer: str, zero_m: Vec3
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Points (n, 3) and their colours (n, 3) of a layer that is made of points; none of another one."""
    tpog, site = session.tpog, rating.site
    if layer == TRAFFIC:
        return shapes.columns(tpog, tpog.p, zero_m)
    if layer in (SEEN, MISSED) and rating.stands:
        crossed = session.hits(site) > 0.0
        part = np.where(crossed == (layer == SEEN), session.entropy_bit, 0.0)
        return shapes.columns(tpog, part, zero_m, float(session.entropy_bit.sum(axis=2).max()))
    if layer == SCAN and rating.stands:
        points = (session.returns_m(site) - zero_m).astype(np.float32)
        return points, np.full(points.shape, _SCAN, dtype=np.uint8)
    return np.empty((0, 3), dtype=np.float32), np.empty((0, 3), dtype=np.uint8)
