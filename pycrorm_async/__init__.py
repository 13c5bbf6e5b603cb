"""Episodic memory for robots: plans remembered as events, asked about as tables."""
