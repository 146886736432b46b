"""Pictures of fits, materials and trades."""
