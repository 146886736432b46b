"""The command ``brdf``."""
