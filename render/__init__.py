"""Pictures of the flower with the measured reflectance."""
