"""PRISM's explicit-state files."""
