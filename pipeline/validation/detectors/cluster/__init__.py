"""Vehicles as a roadside unit without a GPU finds them: new points, clusters, L-shapes, the nearest kind."""
