"""When things at a junction stand in each other's way: every threshold, once, with its reason.

Lengths in metres, in the world frame.
"""

from __future__ import annotations

LANE_INSET_M = 0.25
"""A place stands in a lane when it lies deeper in it than this: nearer to its middle line than half its width less
this. Networks are drawn to a few decimetres, and a pole at the kerb is right."""

CLEARANCE_M = 4.5
"""What is higher than this above the road stands in nobody's way: a sensor on a gantry, a bridge, a crown. The height
that is kept free above carriageways in Germany (https://www.hogeback-landschaftspflege.de/leistungen/lrp/); those of
other countries were not looked up."""

KERB_M = 0.3
"""What is not higher than this above the road is no obstacle: an island, a kerb, the surface of the road itself."""

ROUND_ROI_M = 50.0
"""Solids are held against the lanes in the region of interest and so far round it."""

COVERED_M2 = 2.0
"""A solid that covers less of the lanes than this only touches them, unless its middle stands in one."""

FAR_M = 500.0
"""Static geometry of which nothing is nearer to the region of interest than this belongs to another place: no sensor of
the catalogue reaches farther."""

FEW_BOXES = 2.0
"""Vehicles in the region of interest in a mean frame; with fewer, the ranking rests on hardly any traffic."""

THROUGH_SOLIDS = 0.01
"""Share of what vehicles occupy that static geometry may fill too, by kerbs and poles that share a voxel with them."""
