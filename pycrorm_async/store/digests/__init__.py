"""Store a digest of each episode's events, so that a later change of the log can be detected."""
