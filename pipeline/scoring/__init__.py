"""What a scan is worth: occupancy, hits, entropy and the published score, its uncertainty."""
