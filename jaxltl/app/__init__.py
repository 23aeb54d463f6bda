"""Jobs of the command line, one module for each."""
