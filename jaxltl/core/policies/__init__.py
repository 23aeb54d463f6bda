"""Policies to deploy: finite-memory tables and exported networks, their files and evaluation."""
