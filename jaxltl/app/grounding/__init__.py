"""Jobs of task files with a table ``[grounding]``."""
