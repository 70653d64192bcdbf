"""Effects beyond the plain scene, one module each: rain, fog, foliage and others."""
