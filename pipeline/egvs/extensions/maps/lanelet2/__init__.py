"""Lanelet2 maps, Autoware's included, as SUMO networks."""
