"""Files of other programs: point clouds, OpenStreetMap, XML that is not trusted."""
