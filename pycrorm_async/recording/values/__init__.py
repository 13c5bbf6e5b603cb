"""Convert parameter values to event values: shorten long ones and mark missing ones."""
