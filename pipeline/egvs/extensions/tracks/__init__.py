"""Recorded traffic: tracks of road users from cameras, drones and LiDARs, as boxes at the frames of a scenario."""
