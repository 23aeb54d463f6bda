"""Statistical bounds: binomial, empirical Bernstein, and confidence sets of transition probabilities."""
