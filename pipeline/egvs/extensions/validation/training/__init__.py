"""Training of the PointPillars detector (needs PyTorch)."""
