"""The Unified Markov Binary format."""
