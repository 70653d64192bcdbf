"""What goes beyond the plain scene; each effect is a module, found by its entry point, imported when named."""
