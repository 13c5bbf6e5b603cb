"""Integrations record what other executives perform, through the package `recording`, and answer agents."""
