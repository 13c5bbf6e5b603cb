"""Record the plans of other executives through the package `record`, and answer the questions of agents."""
