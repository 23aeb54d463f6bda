"""Parametric MDPs: rational functions of parameters and their ranges over boxes."""
