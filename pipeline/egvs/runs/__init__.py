"""Running stages: order, cache, locks, and what makes a stage run again."""
