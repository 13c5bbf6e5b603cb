"""Built-in models: primitives, a kitchen, a robot."""
