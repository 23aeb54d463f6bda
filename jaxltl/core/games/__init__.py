"""Games against an environment: objectives, winning regions, strategies and their check."""
