"""Studies of one scenario: what accuracy costs, what effects change, how runs compare."""
