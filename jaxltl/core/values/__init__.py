"""Values and probabilities with their evidence, and their implicit derivatives."""
