"""Exact questions about supports, on the host or traced: attractors, components, acceptance."""
