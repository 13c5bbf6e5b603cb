"""Geometry of grasping, opening and holding."""
