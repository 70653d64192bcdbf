"""Validation on the command line: do scores foretell detection? Its verbs and their tables."""
