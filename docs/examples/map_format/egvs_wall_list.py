"""Walls as lines of text: x1 y1 x2 y2 height, in UTM zone 32."""

import numpy as np
from shapely.geometry import LineString

from egvs.creation.map_parts import ImportCounts, MapContext, MappedSolid, SolidMap


def read_solids(paths, context: MapContext) -> SolidMap:
    counts, solids = ImportCounts(), []
    for path in paths:
        for number, row in enumerate(np.loadtxt(path, ndmin=2), 1):
            ends_m = context.to_world(row[:4].reshape(2, 2), "EPSG:25832", str(path))
            solid = MappedSolid(f"{path.stem}/{number}", "barrier", LineString(ends_m), row[4], "height", radius_m=0.1)
            if context.window.intersects(solid.area):
                counts.keep(solid)
                solids.append(solid)
    return SolidMap(tuple(solids), counts=counts)
