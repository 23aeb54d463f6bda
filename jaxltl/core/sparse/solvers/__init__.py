"""Reachability, total, average, bounded and discounted values of sparse MDPs."""
