"""Terrain, and roads that follow it."""
