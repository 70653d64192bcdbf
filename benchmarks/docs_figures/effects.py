"""Pictures of effects, before and after: the score of columns, or the occupancy of effects on traffic."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import egvs
from benchmarks.docs_figures.printed import ROOT
from egvs.artefacts.readers import read_scores
from egvs.artefacts.tpog import read_tpog
from egvs.artefacts.traffic_frames import read_trajectories
from egvs.drawing.basemap import network_file, roads_within, world_outlines
from egvs.drawing.maps import Backdrop, SiteViewFigure, site_view
from egvs.drawing.svg_figures import extent, standalone_svg
from egvs.effects import registry
from egvs.effects.registry import AUTO_ENABLED
from egvs.results.ranking import RankedSite
from egvs.runs import run
from egvs.runs.run_context import open_folder
from egvs.scenario.effects_config import EffectsConfig
from egvs.scenario.model import Scenario
from egvs.scoring.egvs import EntropyField
from egvs.scoring.scorer import Scorer
from egvs.stages.site_scans import empty_scans
from egvs.world.mesh import read_ply

# effect -> scenario, parameters, site: strong enough to see
EXAMPLES: dict[str, tuple[str, dict[str, Any], str]] = {
    "range_limit": ("nishishinjuku", {"reflectivity": 0.02}, "c08"),
    "rain": ("nishishinjuku", {"rate_mm_h": 60}, "c08"),
    "fog": ("nishishinjuku", {"visibility_m": 150}, "c08"),
    "dropout": ("nishishinjuku", {"share": 0.5}, "c08"),
    "moving_occlusion": ("nishishinjuku", {}, "c08"),
    "divergence": ("nishishinjuku", {"sub_beams": 7, "divergence_mrad": [12.0, 12.0]}, "c08"),
    "mount_sway": ("nishishinjuku", {"tilt_deg": 1.0}, "c08"),
    "foliage": ("nishishinjuku", {"leaf_area_density": 0.5}, "c12"),
    "articulated": ("hill", {}, ""),
    "pedestrians_bicycles": ("hill", {}, ""),
}


def column_scores(scenario: Scenario, out: Path, site: str) -> tuple[np.ndarray, np.ndarray]:
    """Return bits of each column (nx, ny), or mean occupied voxels without a site; and voxels with beams."""
    tpog = read_tpog(out / "tpog.parquet")
    if not site:
        return tpog.p.sum(axis=2), np.ones(tpog.grid.shape, dtype=np.bool_)
    field = EntropyField.of(tpog.counts, tpog.frames, tpog.grid)
    work = open_folder(scenario, out)
    scan = next(empty_scans(work, [site]))
    hits = Scorer(work.scene, tpog, out / "trajectories.parquet").hits(scan.beams)
    score_bit = field.per_cell_bit * np.minimum(hits.ravel()[field.cells], scenario.gamma)
    nx, ny, nz = tpog.grid.shape
    return np.bincount(field.cells // nz, weights=score_bit, minlength=nx * ny).reshape(nx, ny), hits > 0


def before_and_after(name: str, folder: Path) -> Iterator[tuple[str, str]]:
    """Yield file names and figures of one effect."""
    scenario_name, parameters, site = EXAMPLES[name]
    base = egvs.load(ROOT / "scenarios" / scenario_name)
    named_parameters = base.effects.named.get(name)
    combined = (
        {} if named_parameters is None else named_parameters.model_dump(mode="json", exclude_unset=True)
    ) | parameters
    figures = []
    for word, named in (("before", {}), ("after", {name: combined})):
        scenario, out = (
            base.with_effects(EffectsConfig.from_dict({"range_limit": False, **named})),
            folder / scenario_name / (word if named else "plain") / (name if named else ""),
        )
        run.run(scenario, out)
        figures.append((word, *column_scores(scenario, out, site)))
    tpog = read_tpog(out / "tpog.parquet")
    scored = RankedSite.from_table(read_scores(out / "scores.parquet"))
    ranked_site = next(s for s in scored if s.site == (site or scored[0].site))
    box = extent(tpog.grid, [ranked_site])
    roads = roads_within(network_file(out), box)
    backdrop = Backdrop(world_outlines(read_ply(out / "statics.ply")[0], box), roads)
    peak = max(float(field.max()) for _, field, _ in figures)
    for word, field, crossed in figures:
        view = SiteViewFigure(ranked_site, crossed, backdrop, box)
        what = f"score of site {site} by column" if site else "mean occupied voxels by column"
        alt = f"{name}, {word}: {what}, from above, 0 to {peak:.3g}"
        drawn = site_view(tpog.grid, field, peak, view, f"{name}-{word}", alt)
        yield f"{name}-{word}.svg", standalone_svg(drawn)


def side_view(out: Path, pitched: bool) -> str:
    """Draw boxes of one frame on the hill's main road from the south, with heights enlarged five times."""
    rows = read_trajectories(out / "trajectories.parquet").to_pylist()
    busiest = max((sum(r["frame"] == f for r in rows if abs(r["y_m"]) < 9), -f) for f in range(0, 2000, 100))
    shapes = []
    for row in (r for r in rows if r["frame"] == -busiest[1] and abs(r["y_m"]) < 9 and -150 < r["x_m"] < 150):
        tilt = row["pitch_rad"] * math.copysign(1.0, math.cos(row["yaw_rad"])) if pitched else 0.0
        z = row["z_m"] if pitched else row["height_m"] / 2
        corners = [(a * row["length_m"] / 2, b * row["height_m"] / 2) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        turned = [
            (a * math.cos(tilt) - b * math.sin(tilt), a * math.sin(tilt) + b * math.cos(tilt)) for a, b in corners
        ]
        points = " ".join(f"{2 * (row['x_m'] + a) + 310:.1f},{170 - 10 * (z + b):.1f}" for a, b in turned)
        shapes.append(f'<polygon points="{points}" fill="#3b528b" fill-opacity="0.75"/>')
    words = "after: boxes on the grade" if pitched else "before: everything on z = 0"
    text = '<text x="10" y="18" font-family="sans-serif" font-size="13" fill="#555">'
    head = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 620 185" role="img"'
    return f'{head} aria-label="slope, {words}">{text}{words}; heights x 5</text>{"".join(shapes)}</svg>\n'


FILES = tuple(f"effects/{name}-{word}.svg" for name in [*EXAMPLES, "slope"] for word in ("before", "after"))


def draw(folder: Path, images: Path) -> None:
    """Run the scenarios of :data:`EXAMPLES` with and without each effect, and draw both."""
    in_clouds_only = {name for name in registry.effect_names() if registry.load_effect_class(name).STAGE == "clouds"}
    assert set(EXAMPLES) == set(registry.effect_names()) - set(AUTO_ENABLED) - in_clouds_only  # slopes are always on
    (images / "effects").mkdir(parents=True, exist_ok=True)
    for name in EXAMPLES:
        for file, drawn in before_and_after(name, folder):
            (images / "effects" / file).write_text(drawn, encoding="utf-8")
    for word, pitched in (("before", False), ("after", True)):
        drawn = side_view(folder / "hill" / "plain", pitched)
        (images / "effects" / f"slope-{word}.svg").write_text(drawn, encoding="utf-8")
