"""Measured BRDFs: tables of f_r and their files."""
