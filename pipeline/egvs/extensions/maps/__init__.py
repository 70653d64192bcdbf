"""Maps other than OpenStreetMap: city models, Lanelet2, OpenDRIVE, terrain and point clouds."""
