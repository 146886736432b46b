"""Where things are: cameras, shapes, and what a ray meets."""
