"""Measurements that are not tests: speed as ratios from one run, and long hunts for wrong decisions."""
