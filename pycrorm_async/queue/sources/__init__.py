"""Supply a drain with records, and keep the dead letters it leaves."""
