"""Pictures of README and docs, and the printed output that pages quote: ``make docs-figures``."""
