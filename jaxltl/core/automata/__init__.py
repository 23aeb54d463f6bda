"""Deterministic automata of formulas, and questions about their languages. No JAX here."""
