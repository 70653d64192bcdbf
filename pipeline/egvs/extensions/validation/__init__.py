"""Test whether a score predicts detection: simulated point clouds, detectors, average precision, correlation."""
