"""Triangle meshes: how their files are held against bounds, and loaded."""
