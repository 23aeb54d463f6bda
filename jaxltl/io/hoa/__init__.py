"""The Hanoi Omega-Automata format and its extension to games."""
