"""Sources of records for a drain, and the dead letters it leaves."""
