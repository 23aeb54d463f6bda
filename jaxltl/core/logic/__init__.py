"""Temporal logic: formulas, their truth, normal forms and letters. No JAX here."""
