"""Task and game files: their schemas, and the worlds and demonstrations that they name."""
