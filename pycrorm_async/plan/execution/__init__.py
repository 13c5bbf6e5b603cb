"""The execution of a designator: its node, its context, its observer."""
