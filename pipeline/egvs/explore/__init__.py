"""The interactive 3D page of a run."""
