"""Combine designators to plans: expressions, outcomes, monitors, retries and resources."""
