"""Who moves where: SUMO, its networks and demand, recorded traffic, boxes, trajectories."""
