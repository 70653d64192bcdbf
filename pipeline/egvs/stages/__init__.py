"""The stages of a run, one module each, and the inputs that they share."""
