"""Detectors of vehicles: those that are shipped, and files with the boxes of any other one."""
