"""The plan language: expressions of actions, their outcomes, monitors and resources."""
