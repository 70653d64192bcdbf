"""A city: one traffic, and an ordinary scenario for each of its junctions."""
