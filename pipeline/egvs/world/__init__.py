"""The static world: terrain, buildings and other solids as one mesh, and rays cast at it."""
