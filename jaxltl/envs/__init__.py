"""Worlds to learn in."""
