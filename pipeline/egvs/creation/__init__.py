"""Scenarios made from OpenStreetMap."""
