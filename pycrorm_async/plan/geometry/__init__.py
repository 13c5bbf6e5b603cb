"""Compute poses for grasping, opening and holding, and check what a gripper can take."""
