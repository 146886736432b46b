"""Materials in files, presets, and what other programs load."""
