"""New scenarios, made from maps and recordings."""
