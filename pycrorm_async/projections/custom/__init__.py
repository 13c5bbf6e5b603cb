"""Custom projections: those of the user's own."""
