"""``egvs city``: every junction of a city."""
