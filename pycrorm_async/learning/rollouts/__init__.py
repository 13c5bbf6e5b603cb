"""Perform rollouts of move-and-pick-up in one or several processes, and read them back from a memory."""
