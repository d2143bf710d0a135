"""Light sensors."""
