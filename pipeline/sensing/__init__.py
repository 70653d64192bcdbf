"""What a sensor in some pose sees: sensors, sites, the scene, the scanner."""
