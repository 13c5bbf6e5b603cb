"""The fold: from events to rows."""
