"""What detectors find in the fused clouds of a plan's sensors: what a second and a third LiDAR bring in detection."""
