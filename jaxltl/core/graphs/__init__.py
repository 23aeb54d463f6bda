"""Exact questions about supports: attractors, end components, acceptance."""
