"""Values of small Markov chains and MDPs in rational arithmetic."""
