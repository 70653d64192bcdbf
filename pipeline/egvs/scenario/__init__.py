"""The scenario file ``scenario.toml``: its keys as typed models, and loading."""
