"""The Hanoi Omega-Automata (HOA) format and its extension to synthesis games."""
