"""Record the plans of other executives through the package `recording`, and answer the questions of agents."""
