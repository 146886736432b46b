"""What the light samples at a point add up to."""
