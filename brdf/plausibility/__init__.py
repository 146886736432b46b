"""Positivity, reciprocity, energy."""
