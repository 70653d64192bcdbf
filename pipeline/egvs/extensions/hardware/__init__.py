"""Real sensors: fitted to their sweeps, designed, installed and accepted."""
