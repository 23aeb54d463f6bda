"""Reachability, satisfaction probabilities and total rewards."""
