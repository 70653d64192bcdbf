"""Scenarios made from other people's maps."""
