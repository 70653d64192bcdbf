"""What stands there: footprints, meshes, terrain, one triangle mesh, and casting rays at it."""
