"""Actions of a mobile manipulator and the descriptions they are grounded from."""
