"""Files of other programs: coordinates, OpenStreetMap, meshes, point clouds."""
