"""Describe robots and solve their inverse kinematics."""
