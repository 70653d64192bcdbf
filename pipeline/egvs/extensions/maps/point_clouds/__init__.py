"""As-built point clouds as the static world."""
