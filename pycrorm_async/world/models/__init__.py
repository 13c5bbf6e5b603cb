"""Built-in models as URDF text: primitive shapes, a kitchen, a PR2."""
