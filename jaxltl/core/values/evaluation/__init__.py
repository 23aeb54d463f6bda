"""Statistical evaluation of policies and guarantees from data."""
