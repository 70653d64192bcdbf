"""Pictures of the study, drawn from its tables: rho by gamma, detection by height, all scores.

Each shows the first measure of each detector, the one by which things are chosen; tables have them all.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.validity import junctions
from benchmarks.validity.agreement import WORDS
from benchmarks.validity.record import measures_of
from benchmarks.validity.tables import Table
from egvs.clouds.sweeps import POINT_COUNTS_NAME
from egvs.core import files

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DARK, _MID, _LIGHT = "#0072B2", "#D55E00", "#777777"
_ABREAST = 3
_STYLES = {"0.25": (_DARK, "o"), "0.5": (_MID, "s"), "1": (_LIGHT, "^")}


def draw(folder: Path, tables: Sequence[Table]) -> list[Path]:
    """Write the figures as PNG; those whose tables are there."""
    of = {table.name: table for table in tables}
    first = {measures_of(POINT_COUNTS_NAME)[0], measures_of("")[0]}
    settings = [name for name in of if name.startswith("A ") and not name.startswith("A sites")]
    by_setting = [of[name] for name in settings if name.split()[-1] in first]
    ranked = [of[name] for name in of if name.startswith("D ") and name.split()[-1] in first]
    recommended = [of[name] for name in of if name.startswith("F ") and name.split()[-1] == measures_of("")[0]]
    made = {
        "validity-gamma.png": gamma(by_setting) if by_setting else None,
        "validity-heights.png": heights(of["C heights"]) if of["C heights"].rows else None,
        "validity-scores.png": scores(ranked) if ranked else None,
        "validity-recommended.png": recommendation(recommended) if recommended else None,
    }
    written = []
    for name, figure in made.items():
        if figure is not None:
            with files.atomic_write(folder / name) as partial:
                figure.savefig(partial, dpi=130, format="png", metadata={"Software": None})
            written.append(folder / name)
    return written


def gamma(tables: Sequence[Table]) -> Figure:
    """Rho against gamma: a column a detector and measure, a row a role."""
    roles = [name for name in ("training", "held out") if name in {c.heading for c in tables[0].columns}]
    figure, panels = _panels(len(roles), len(tables), 4.0, 3.2)
    for column, table in enumerate(tables):
        for row, role in enumerate(roles):
            axes = panels[row, column]
            _gamma_lines(axes, table, role)
            axes.set(ylim=_rho_limits(tables, roles), xlabel="gamma", ylabel=f"rho, {role}" if column == 0 else "")
            axes.set_title(_what(table), fontsize=9)
    panels[-1, 0].legend(fontsize=6.5, loc="lower left", handlelength=3.5)
    return figure


def _rho_limits(tables: Sequence[Table], roles: Sequence[str]) -> tuple[float, float]:
    """From 0, or -1 where some rho or its interval is below, to 1."""
    cells = [cell for table in tables for role in roles for cell in table.column(role) if cell is not None]
    return (-1.05 if any(end is not None and end < 0.0 for cell in cells for end in cell) else 0.0), 1.05


def _gamma_lines(axes: Any, table: Table, role: str) -> None:
    gammas = list(dict.fromkeys(table.column("gamma")))
    grounds = zip(table.column("voxel, m"), table.column("moving occlusion"), strict=True)
    for voxel, occlusion in dict.fromkeys(grounds):
        rows = zip(
            table.column("gamma"), table.column("voxel, m"), table.column("moving occlusion"), table.column(role),
            strict=True,
        )  # fmt: skip
        points = [
            (gammas.index(g), cell) for g, v, o, cell in rows if (v, o) == (voxel, occlusion) and cell is not None
        ]
        colour, marker = _STYLES[voxel]
        line = "--" if occlusion == "yes" else "-"
        label = f"voxel {voxel} m" + (", moving occlusion" if occlusion == "yes" else "")
        axes.plot(
            [x for x, _ in points], [c[0] for _, c in points], line, color=colour, marker=marker, ms=4, label=label
        )
        if (voxel, occlusion) == ("0.25", "no"):
            known = [(x, c) for x, c in points if c[1] is not None]
            axes.fill_between(
                [x for x, _ in known], [c[1] for _, c in known], [c[2] for _, c in known], color=colour, alpha=0.12
            )
    axes.set_xticks(range(len(gammas)), gammas)


def heights(table: Table) -> Figure:
    """Detection against mounting height: a panel a detector and measure, a line a junction, training ones dashed,
    held-out ones together in bold."""
    pairs = dict.fromkeys(zip(table.column("detector"), table.column("measure"), strict=True))
    kinds = [(name, measure) for name, measure in pairs if measure == WORDS[measures_of(name)[0]] and " " not in name]
    rows = -(-len(kinds) // _ABREAST)
    figure, panels = _panels(rows, min(len(kinds), _ABREAST), 4.0, 3.4)
    marks = [
        column.heading for column in table.columns if column.heading.endswith(" m") and "minus" not in column.heading
    ]
    metres = [float(mark.split()[0]) for mark in marks]
    lines = [name for name in dict.fromkeys(table.column("junction")) if name not in ("training", "held out")]
    colours = {name: f"C{number}" for number, name in enumerate(lines)}
    roles = junctions.SHIPPED | {name: role for role, name in junctions.OSM.items()}
    for axes in panels.ravel()[len(kinds) :]:
        axes.remove()
    for axes, (detector, measure) in zip(panels.ravel(), kinds, strict=False):
        for row in range(len(table.rows)):
            if (table.column("detector")[row], table.column("measure")[row]) != (detector, measure):
                continue
            name, cells = table.column("junction")[row], [table.column(mark)[row] for mark in marks]
            if any(cell is None for cell in cells):
                continue
            values = [cell[0] for cell in cells]
            if name == "held out":
                axes.plot(metres, values, color="black", linewidth=2.2, marker="o", label=name)
                known = [(at, cell) for at, cell in zip(metres, cells, strict=True) if cell[1] is not None]
                for at, cell in known:
                    axes.plot([at, at], cell[1:], color="black", linewidth=1.2)
            elif name != "training":
                line = "-" if roles.get(name) == "held out" else "--"
                axes.plot(metres, values, line, color=colours[name], linewidth=1.0, marker=".", label=name)
        axes.set(xlabel="height above the ground, m", ylabel=f"{measure}, %", xticks=metres)
        axes.set_ylim(0.0, 100.0)
        axes.set_title(detector, fontsize=9)
    panels[0, 0].legend(fontsize=6.5, loc="lower left")
    return figure


def scores(tables: Sequence[Table]) -> Figure:
    """Every score's rho on training junctions (open) and held-out ones (filled), with intervals."""
    figure, panels = _panels(1, len(tables), 5.4, 0.8 + 0.3 * max(len(table.rows) for table in tables))
    for axes, table in zip(panels[0], tables, strict=True):
        for heading, shift, face in (("rho, training", -0.15, "white"), ("rho, held out", 0.15, _DARK)):
            for line, cell in enumerate(table.column(heading)):
                if cell is not None:
                    if cell[1] is not None:
                        axes.plot(cell[1:], [line + shift] * 2, color="0.6", linewidth=1.3, zorder=1)
                    axes.scatter([cell[0]], [line + shift], s=24, facecolors=face, edgecolors=_DARK, zorder=3)
        axes.set_yticks(range(len(table.rows)), table.column("score"), fontsize=6.5)
        axes.set(ylim=(len(table.rows) - 0.5, -0.5), xlim=(-1.05, 1.05), xlabel="rho: open training, filled held out")
        axes.axvline(0.0, color="0.5", linewidth=0.8)
        axes.set_title(_what(table), fontsize=9)
    return figure


def recommendation(tables: Sequence[Table]) -> Figure:
    """Rho at junctions that nothing was learnt from: the recommended score with its interval, and the EGVS."""
    marks = [
        ("EGVS, gamma 10", "EGVS, gamma 10", "o", "white", _LIGHT),
        ("rho of that setting", "EGVS at its best there, known afterwards", "^", "white", _MID),
        ("recommended", "recommended: expected_detections", "o", _DARK, _DARK),
    ]
    figure, panels = _panels(1, len(tables), 5.2, 1.2 + 0.27 * max(len(table.rows) for table in tables))
    for axes, table in zip(panels[0], tables, strict=True):
        for heading, label, marker, face, edge in marks:
            cells = [(line, cell) for line, cell in enumerate(table.column(heading)) if cell is not None]
            axes.scatter(
                [cell[0] for _, cell in cells], [line for line, _ in cells], s=26, marker=marker, facecolors=face,
                edgecolors=edge, zorder=3, label=label,
            )  # fmt: skip
            for line, cell in cells:
                if heading == "recommended" and cell[1] is not None:
                    axes.plot(cell[1:], [line, line], color=edge, linewidth=1.3, zorder=2)
        names = zip(table.column("junction"), table.column("sites"), table.column("number of sites"), strict=True)
        axes.set_yticks(range(len(table.rows)), [f"{name}, {sensor}: {n}" for name, sensor, n in names], fontsize=7)
        axes.set(ylim=(len(table.rows) - 0.5, -0.5), xlim=(0.0, 1.02), xlabel="rho")
        axes.set_title(_what(table), fontsize=9)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(marks), fontsize=7)
    return figure


def _what(table: Table) -> str:
    _, detector, measure = table.name.split()
    return f"{detector}: {WORDS[measure]}"


def _panels(rows: int, columns: int, width: float, height: float) -> tuple[Figure, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.ravel():
        axes.grid(True, color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=7)
    return figure, panels
