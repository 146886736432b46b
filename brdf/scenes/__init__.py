"""The scene, and its files."""
