"""Preprocessing of questions that are solved many times with other numbers."""
