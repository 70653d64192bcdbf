"""What may be laid over the scene: traffic, what a sensor sees and misses of it, its scan, recorded vehicles.

Each layer draws itself in place of the one before, and says in a legend (HTML) what its colours mean.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from pipeline.core.grid import Vec3
from pipeline.explore.drawing import shapes, vehicles
from pipeline.explore.drawing.shapes import Points
from pipeline.explore.playback import Playback
from pipeline.explore.session import Rating, Session
from pipeline.explore.view import View

NAME = "/layer"
"""Of what is laid over it, in the scene; what is more than points or lines lies below it."""

_RETURN_M, _BEAM_M = 0.12, 0.04
_SCAN, _STATIC, _SEEN, _NOT_SEEN = (200, 30, 80), (150, 150, 150), (0, 90, 181), (220, 95, 0)
_THIS, _OTHER, _BOTH = (0, 90, 181), (220, 95, 0), (222, 222, 222)
_STEPS = 8

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Drawn:
    """What a layer is drawn of.

    Attributes
    ----------
    rating, view
        The sensor as it is now, and what else is asked for.
    other
        The site that differences are taken to; None where there is no other.
    zero_m
        The point of the world that is the page's zero.
    """

    scene: viser.SceneApi
    session: Session
    playback: Playback
    rating: Rating
    view: View
    other: Rating | None
    zero_m: Vec3

    def points(self, points: Points, colours: Bytes, size_m: float) -> None:
        """Draw points (n, 3) with their colours; nothing where there are none."""
        if len(points):
            self.scene.add_point_cloud(
                NAME, points, colours, point_size=size_m, precision="float32", point_shading="flat"
            )


def draw(its: Drawn) -> str:
    """Lay a layer over a scene in place of what was there, nothing where the sensor cannot stand; its legend."""
    its.scene.remove_by_name(NAME)
    draws = _LAYERS.get(its.view.layer)
    if draws is None or (not its.rating.stands and its.view.layer not in ("traffic", "replay")):
        return ""
    return draws(its)


def _traffic(its: Drawn) -> str:
    tpog = its.session.tpog
    points, colours = shapes.columns(tpog, tpog.p, its.zero_m)
    its.points(points, colours, tpog.grid.voxel_m)
    return _scale("share of time occupied, added up along z", 0.0, float(tpog.p.sum(axis=2).max(initial=0.0)))


def _entropy(its: Drawn) -> str:
    session, is_seen = its.session, its.view.layer == "seen"
    crossed = session.hits(its.rating.site) > 0.0
    peak = float(session.entropy_bit.sum(axis=2).max(initial=0.0))
    part = np.where(crossed == is_seen, session.entropy_bit, 0.0)
    points, colours = shapes.columns(session.tpog, part, its.zero_m, peak)
    its.points(points, colours, session.tpog.grid.voxel_m)
    what = "where beams pass" if is_seen else "where no beam passes"
    return _scale(f"bits of entropy {what}, added up along z", 0.0, peak)


def _blindspots(its: Drawn) -> str:
    found = its.session.blindspots(its.rating.site)
    ix, iy = np.nonzero(~np.isnan(found.share_missed))
    middle = np.column_stack([ix + 0.5, iy + 0.5, np.zeros(len(ix))]) * found.cell_m
    corner_m = np.array([*found.origin_m, shapes.ABOVE_LANES_M])
    points = middle + corner_m - its.zero_m
    its.points(points.astype(np.float32), shapes.scale(found.share_missed[ix, iy], 0.0, 1.0), found.cell_m)
    worst = [f"{place.words}: {place.share:.0%} seen" for place in found.worst]
    whole = f"all vehicles: {found.whole.share:.1%} seen" if found.whole is not None else "no vehicle was recorded"
    legend = _scale(f"vehicles with fewer than {found.points:g} points", 0.0, 1.0, "{:.0%}")
    return legend + _lines([f"<b>{_plain(whole)}</b>", *map(_plain, worst)])


def _difference(its: Drawn) -> str:
    if its.other is None or not its.other.stands:
        return _lines(["there is no other site"])
    session, entropy = its.session, its.session.entropy_bit
    this, other = (session.hits(rating.site) > 0.0 for rating in (its.rating, its.other))
    only_this, only_other = (np.where(one & ~two, entropy, 0.0) for one, two in ((this, other), (other, this)))
    points, colours = shapes.differences(session.tpog, only_this, only_other, its.zero_m, (_THIS, _OTHER, _BOTH))
    its.points(points, colours, session.tpog.grid.voxel_m)
    names = its.rating.site.name, its.other.site.name
    bits = float(only_this.sum()), float(only_other.sum())
    rows = zip((_THIS, _OTHER), names, bits, strict=True)
    return _swatches([(colour, f"{name} alone sees {bit:,.1f} bit") for colour, name, bit in rows])


def _scan(its: Drawn) -> str:
    points = (its.session.returns_m(its.rating.site) - its.zero_m).astype(np.float32)
    its.points(points, np.full(points.shape, _SCAN, dtype=np.uint8), _RETURN_M)
    return _swatches([(_SCAN, f"{len(points):,} returns of beams that can meet the region")])


def _ring(its: Drawn) -> str:
    lines = (its.session.beams_m(its.rating.site, its.view.ring) - its.zero_m).astype(np.float32)
    if len(lines):
        its.scene.add_line_segments(NAME, lines, _SCAN, thickness=_BEAM_M)
    return _swatches([(_SCAN, f"{len(lines):,} beams of the ring that can meet the region")])


def _replay(its: Drawn) -> str:
    played = its.playback
    moment = played.moment(its.rating.site, its.view.frame)
    of_vehicles = moment.owner >= 0
    colours = np.where(of_vehicles[:, None], _SCAN, _STATIC).astype(np.uint8)
    its.points((moment.returns_m - its.zero_m).astype(np.float32), colours, _RETURN_M)
    if not len(moment.returns_m):
        its.scene.add_frame(NAME, show_axes=False)  # vehicles lie below it
    seen = moment.is_seen
    for name, which, colour in (("seen", seen, _SEEN), ("missed", ~seen, _NOT_SEEN)):
        if which.any():
            body = vehicles.bodies(moment.frame, played.kinds(moment.frame), played.parts, which, its.zero_m)
            its.scene.add_mesh_simple(
                f"{NAME}/{name}", body.points, body.faces, color=colour, flat_shading=True, cast_shadow=False
            )
    said = [(_SEEN, f"{int(seen.sum())} with 20 returns or more"), (_NOT_SEEN, f"{int((~seen).sum())} with fewer")]
    return _swatches([*said, (_SCAN, f"{int(of_vehicles.sum()):,} returns of vehicles")])


_LAYERS: dict[str, Callable[[Drawn], str]] = {
    "traffic": _traffic,
    "seen": _entropy,
    "missed": _entropy,
    "blindspots": _blindspots,
    "difference": _difference,
    "scan": _scan,
    "ring": _ring,
    "replay": _replay,
}


def _scale(what: str, low: float, high: float, form: str = "{:.3g}") -> str:
    """A bar of colours with its ends."""
    stops = shapes.scale(np.linspace(0.0, 1.0, _STEPS))
    bar = f"linear-gradient(to right, {', '.join(map(_css, stops.tolist()))})"
    ends = f"<span>{form.format(low)}</span><span>{form.format(high)}</span>"
    flex = "display:flex;justify-content:space-between"
    return _boxed(f'{what}<div style="height:0.7em;background:{bar}"></div><div style="{flex}">{ends}</div>')


def _swatches(rows: Sequence[tuple[Sequence[int], str]]) -> str:
    square = "display:inline-block;width:0.8em;height:0.8em;margin-right:0.5em"
    return _lines([f'<span style="{square};background:{_css(colour)}"></span>{_plain(said)}' for colour, said in rows])


def _lines(rows: Sequence[str]) -> str:
    return _boxed("".join(f"<div>{row}</div>" for row in rows))


def _boxed(content: str) -> str:
    return f'<div style="margin:0.3em 0.8em;font-size:0.85em;line-height:1.5">{content}</div>'


def _css(colour: Sequence[int]) -> str:
    return f"rgb({', '.join(str(int(value)) for value in colour)})"


def _plain(text: str) -> str:
    """A text that HTML shows as it is."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
