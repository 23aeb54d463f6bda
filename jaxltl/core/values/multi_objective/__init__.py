"""Several objectives at once, and Pareto fronts."""
