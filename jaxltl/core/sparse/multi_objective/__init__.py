"""Weighted sums of objectives and Pareto fronts."""
