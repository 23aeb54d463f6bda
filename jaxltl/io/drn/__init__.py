"""Storm's DRN text format, with and without parameters."""
