"""Effects on what a beam is worth in a voxel."""
