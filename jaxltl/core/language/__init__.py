"""The PRISM language: expressions, guarded commands and programs; without JAX."""
