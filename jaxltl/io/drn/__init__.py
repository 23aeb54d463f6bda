"""DRN, Storm's text format, and its parametric models."""
