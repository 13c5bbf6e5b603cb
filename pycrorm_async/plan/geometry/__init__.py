"""Compute poses for grasping, opening and holding, and check whether a gripper can take an object."""
