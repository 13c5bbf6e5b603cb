"""Define motions, and the process modules that execute them."""
