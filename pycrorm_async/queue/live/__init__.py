"""The queue of a living recorder."""
