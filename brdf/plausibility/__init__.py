"""Positivity, reciprocity, energy; stability."""
