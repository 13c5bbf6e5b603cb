"""Write the episodes of any executive, including those of our own plan layer."""
