"""Built-in actions of a mobile manipulator, and descriptions that resolve to them."""
