"""Discounted values: of policies, optimal, soft, and of zero-sum games."""
