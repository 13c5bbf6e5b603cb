"""Fit, sample, store and draw policies for move-and-pick-up."""
