"""How well a score and detection agree over sites, and how sure that is."""
