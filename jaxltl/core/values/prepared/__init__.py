"""One question solved with many numbers, inside jit, vmap and grad."""
