"""Long-run average rewards and mean payoffs."""
