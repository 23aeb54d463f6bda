"""One module per learner, all of the same shape."""
