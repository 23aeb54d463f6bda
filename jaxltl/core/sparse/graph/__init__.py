"""Graph algorithms on sparse rows: components, attractors, qualitative preprocessing."""
