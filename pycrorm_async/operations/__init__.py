"""Parts that run for an operator: processes that the daemon starts, watches and replaces."""
