"""Policies over pick-ups: the default one, those learned from what a memory holds, and how they are tried out."""
