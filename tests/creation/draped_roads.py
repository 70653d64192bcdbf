"""Grounds by formulas, and a small network that lies on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egvs.core.grid import FloatArray
from egvs.traffic import sumo


@dataclass(frozen=True)
class Function:
    """A ground by a formula; unknown beyond x = 1000 m."""

    of: Callable[[FloatArray, FloatArray], FloatArray]
    notes: tuple[str, ...] = ()

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        x, y = xy_m.T
        return np.where(x <= 1000, self.of(x, y), np.nan)


PLANE = Function(lambda x, y: 200 + 0.04 * x - 0.02 * y)
VALLEY = Function(lambda x, y: 100 - 12 * np.exp(-(((x - 150) / 40) ** 2)))

NODES = """<nodes><node id="a" x="0" y="0"/><node id="b" x="100" y="0"/><node id="c" x="200" y="0"/>
<node id="d" x="300" y="0"/><node id="u" x="150" y="-80"/><node id="v" x="150" y="80"/></nodes>"""


def build(folder: Path, edges: str = "ab bc cd uv") -> str:
    """A road along x over the nodes a, b, c, d; another crosses it between b and c without a junction."""
    (folder / "n.nod.xml").write_text(NODES)
    both = "".join(f'<edge id="{e}" from="{e[0]}" to="{e[1]}" numLanes="2"/>' for e in edges.split())
    back = "".join(f'<edge id="-{e}" from="{e[1]}" to="{e[0]}"/>' for e in edges.split())
    (folder / "e.edg.xml").write_text(f"<edges>{both}{back}</edges>")
    flags = ["--offset.disable-normalization", "--precision", "3", "--no-turnarounds"]
    sumo.run_netconvert(["-n", "n.nod.xml", "-e", "e.edg.xml", *flags], folder, "net.net.xml")
    return (folder / "net.net.xml").read_text()
