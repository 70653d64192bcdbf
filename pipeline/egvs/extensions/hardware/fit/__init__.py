"""Fit a sensor of a scenario to sweeps that an installed LiDAR recorded (``egvs sensor fit``)."""
