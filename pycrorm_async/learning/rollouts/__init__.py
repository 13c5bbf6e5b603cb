"""Rollouts of move-and-pick-up: performed in kitchens, in many processes, and read back from a memory."""
