"""Sensors and sites: beams, poses, candidate sites, and the empty scan from a pose."""
