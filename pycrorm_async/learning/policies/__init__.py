"""Policies for move-and-pick-up: fitted, stored, drawn."""
