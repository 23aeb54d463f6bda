"""Models of programs in the PRISM language."""
