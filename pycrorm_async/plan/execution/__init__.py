"""Execute designators: create nodes, enter execution contexts, notify the observer, simulate plans."""
