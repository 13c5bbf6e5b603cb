"""Motions and the process modules that execute them."""
