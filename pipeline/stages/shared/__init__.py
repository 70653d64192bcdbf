"""What several stages read of a run's folder: the static world, the scene, the empty scans."""
