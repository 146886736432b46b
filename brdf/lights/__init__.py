"""Lights: each turns into light samples at a surface point."""
