"""Model checking: dispatches a property to its solver."""
