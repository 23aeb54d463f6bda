"""Step-bounded and reward-bounded values of MDPs, games and uncertain models."""
