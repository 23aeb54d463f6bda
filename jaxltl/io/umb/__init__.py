"""The Unified Markov Binary (UMB) format."""
