"""Partially observable models: controllers, beliefs and certified bounds."""
