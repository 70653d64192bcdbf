"""Thresholds of the checks of sites, solids and traffic at a junction, with their reasons. World frame, metres."""

from __future__ import annotations

LANE_INSET_M = 0.25
"""A site is in a lane when it is closer to the lane's centre line than half the width less this. Networks are accurate
to a few decimetres, and a pole at the kerb is fine."""

CLEARANCE_M = 4.5
"""Objects higher than this above the road obstruct nobody: a sensor on a gantry, a bridge, a crown. It is the height
that is kept free above carriageways in Germany (https://www.hogeback-landschaftspflege.de/leistungen/lrp/); other
countries were not checked."""

KERB_M = 0.3
"""Objects up to this height above the road are no obstacle: an island, a kerb, the surface of the road itself."""

ROI_MARGIN_M = 50.0
"""Solids are compared with the lanes in the region of interest and this far around it."""

MIN_COVERED_M2 = 2.0
"""A solid that covers less of the lanes than this only touches them, unless its centre is in one."""

MAX_STATICS_DISTANCE_M = 500.0
"""Static geometry that is entirely farther from the region of interest than this belongs to another location: no sensor
of the catalogue has a longer range."""

MIN_MEAN_VEHICLES = 2.0
"""Mean number of vehicles in the region of interest; with fewer, the ranking is based on hardly any traffic."""

MAX_SHARE_IN_SOLIDS = 0.01
"""Share of the occupied voxels that static geometry may fill too, from kerbs and poles that share a voxel with
vehicles."""
