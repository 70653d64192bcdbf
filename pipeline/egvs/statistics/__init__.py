"""Statistics of samples: intervals, blocks and ranks."""
