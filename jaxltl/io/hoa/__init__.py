"""The Hanoi Omega-Automata (HOA) format."""
