"""Access of compiled programs to sparse models."""
