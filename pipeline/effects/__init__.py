"""What goes beyond the plain scene: each effect a module, imported only when named."""
