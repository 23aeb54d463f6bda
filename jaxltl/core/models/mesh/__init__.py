"""Models and batches over the devices of a mesh."""
