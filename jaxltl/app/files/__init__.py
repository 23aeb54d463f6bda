"""Files that people write: tasks, games and their tables."""
