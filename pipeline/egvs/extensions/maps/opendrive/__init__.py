"""OpenDRIVE maps as SUMO networks."""
