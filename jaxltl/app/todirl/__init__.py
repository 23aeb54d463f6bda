"""Parts of todirl jobs: results, guarantees, and the summary."""
