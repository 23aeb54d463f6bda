"""Files of other tools: automata in the Hanoi format."""
