"""The study behind docs/validity.md: does a score foretell what detectors find, on junctions that chose nothing?"""
