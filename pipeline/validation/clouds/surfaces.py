r"""How bright a return is: what a diffuse surface sends back.

.. math:: I = \rho \cos\theta, \quad 0 \le I \le 1

with the surface's reflectivity :math:`\rho` and the angle of incidence :math:`\theta` (Lambert). A return's power also
falls as :math:`1/r^2` (Höfle and Pfeifer 2007, ISPRS J. Photogramm. Remote Sens. 62(6), 415-433); sensors that report
a calibrated reflectivity take that out again, as here. Gloss, retroreflectors and the wear of paint are left out.

Reflectivities at 900 nm. From Wehr and Lohr (1999, ISPRS J. Photogramm. Remote Sens. 54, 68-82, table of typical
reflectivities): asphalt with pebbles 17 %, smooth concrete 24 %, deciduous trees 60 %, black rubber of a tyre's wall 2
%. Assumed: paint 45 %, between a dark vehicle (10 %) and a white one (80 %), one value for all; a window 10 %: glass
mirrors most of what does not go through, and what returns comes from frames, dirt and seats; cloth 30 %.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

REFLECTIVITY = {"paint": 0.45, "glass": 0.10, "tyre": 0.02, "cloth": 0.30, "ground": 0.17, "leaves": 0.60, "wall": 0.24}

_OF_SOLIDS = {"ground": "ground", "tree_crown": "leaves"}
"""Kinds of solids that are no walls."""


def of_solids(kinds: Iterable[str]) -> NDArray[np.float64]:
    """The reflectivity of each solid of the static world, (solids,)."""
    return np.array([REFLECTIVITY[_OF_SOLIDS.get(kind, "wall")] for kind in kinds], dtype=np.float64)
