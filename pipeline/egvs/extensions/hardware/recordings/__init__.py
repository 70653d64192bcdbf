"""Recordings of sweeps: ROS bags and network captures."""
