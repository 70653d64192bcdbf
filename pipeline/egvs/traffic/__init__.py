"""Traffic: SUMO networks and simulations, floating car data, vehicle boxes, trajectories."""
