"""Count and draw how often actions succeeded, over any two columns of a view."""
