"""Record events in the queue of a living recorder."""
