"""Fit models of the probability that a detector finds a vehicle, from what a site sees of it."""
