"""Make cases from the events of episodes, and store them as blocks beside the memory's tables."""
