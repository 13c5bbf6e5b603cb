"""Robots: their description and inverse kinematics."""
