"""Environments: the protocol, task environments, monitors, episodes, tabulation."""
