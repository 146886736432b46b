"""Speed against accuracy: measured, promised, and acted on."""
