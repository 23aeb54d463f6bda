"""Primitives on models: expectation, pushforward, successors, reductions over choices."""
